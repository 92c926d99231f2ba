from .alignment.align import align
from .attribution.attribute import correlate
from .campaign.config import load_campaign
from .diagnosis.diagnose import diagnose
from .effects.effect import Candidate, Effect
from .errors import FusionError
from .loop.axis import close_loop
from .pipeline.run import run_campaign
from .products.results import results_schema
from .report.exports.export import export_results
from .report.html import render_report
from .twin.instruments import simulate_campaign

__all__ = [
    "Candidate",
    "Effect",
    "FusionError",
    "align",
    "close_loop",
    "correlate",
    "diagnose",
    "export_results",
    "load_campaign",
    "render_report",
    "results_schema",
    "run_campaign",
    "simulate_campaign",
]
