"""Thermograms and deviations on one clock: attribution, diagnosis, the closed loop, the report and the command.

Levels of the data: as written by a user (:mod:`fusion.campaign`), fused (:mod:`fusion.analysis.alignment` to
:mod:`fusion.analysis.drift_model`, and
:mod:`fusion.analysis.drift_model`), shown (:mod:`fusion.report`). :mod:`fusion.pipeline` runs the stages; :mod:`fusion.twin` simulates a
machine of known
truth and shares nothing with the analysis but the file formats::

    results = run_campaign("campaign.toml", "results")
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
