"""The digital twin: simulates a campaign of known truth and writes the files that real instruments would write.

`simulate` gives every reading and its parts without rendering a frame; `write_campaign` renders the frames and writes the folder;
`simulate_campaign` does both from a RECIPE.toml. `deviations_of` and `fields_of` give the truth as Datasets, without files, for studies
by simulation. The twin shares no code with the analysis but the writers of the file formats.
"""

from fusion.twin.camera import make_view
from fusion.twin.folders import truth_folder
from fusion.twin.instruments import deviations_of, fields_of, simulate_campaign, write_campaign
from fusion.twin.recipe import Recipe, RecipeError
from fusion.twin.recipe_file import packaged_recipe, read_recipe
from fusion.twin.record import RecordTruth, simulate_record
from fusion.twin.simulate import Truth, driver_log, environment_log, simulate

__all__ = [
    "Recipe",
    "RecipeError",
    "RecordTruth",
    "Truth",
    "deviations_of",
    "driver_log",
    "environment_log",
    "fields_of",
    "make_view",
    "packaged_recipe",
    "read_recipe",
    "simulate",
    "simulate_campaign",
    "simulate_record",
    "truth_folder",
    "write_campaign",
]
