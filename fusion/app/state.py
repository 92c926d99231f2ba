"""What one page of the application knows: the folder, the campaign and the results that its screens share."""

from __future__ import annotations

from pathlib import Path

import param

from fusion.app.run.process import RUNS


class State(param.Parameterized):
    """Choices of one page; a screen watches those that it shows.

    Attributes
    ----------
    root : Path
        Folder for which the application was started: nothing outside it is read or written.
    folder : Path or None
        Folder of the measurement.
    campaign : Path or None
        Campaign file that is set up or run.
    results : Path or None
        Results folder of a finished run.
    screen : str
        Name of the screen that is shown; setting it goes there.
    """

    root: Path = param.ClassSelector(class_=Path, constant=True)
    folder: Path | None = param.ClassSelector(class_=Path, default=None, allow_None=True)
    campaign: Path | None = param.ClassSelector(class_=Path, default=None, allow_None=True)
    results: Path | None = param.ClassSelector(class_=Path, default=None, allow_None=True)
    screen: str = param.String(default="")


def state_of(root: Path) -> State:
    """Return the state with which a page opens.

    Parameters
    ----------
    root : Path
        Folder for which the application was started.

    Returns
    -------
    State
        With the campaign file and the results of the run that was started last, from whatever page; before the first one with those that
        lie in the folder itself.
    """
    top, run = root.resolve(), RUNS.latest
    campaign, results = (run.campaign, run.results) if run else (top / "campaign.toml", top / "results")
    return State(
        root=top,
        folder=campaign.parent,
        campaign=campaign if campaign.is_file() else None,
        results=results if (results / "results.json").is_file() else None,
    )
