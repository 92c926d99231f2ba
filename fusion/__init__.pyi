from .analysis.alignment.align import AxisGeometry, align, cycle_bounds
from .analysis.alignment.readings import Readings
from .analysis.attribution.correlate import correlate
from .analysis.diagnosis.diagnose import diagnose
from .analysis.drift_model.closed_loop import close_loop
from .analysis.drift_model.evaluation import LoopResult
from .analysis.drift_model.record_data import Record, reduce_record
from .analysis.effects.effect import Candidate, Effect
from .campaign.config import load_campaign
from .campaign.inputs import read_record
from .campaign.logs import read_drivers
from .campaign.remote import fetch_sample
from .common import FusionError
from .pipeline.run import run_campaign
from .report.exports.export import export_results
from .report.page import render_report
from .results.plots import plot_correlation, plot_loop
from .results.results import Results, read_results, results_schema
from .twin.instruments import simulate_campaign

__all__ = [
    "AxisGeometry",
    "Candidate",
    "Effect",
    "FusionError",
    "LoopResult",
    "Readings",
    "Record",
    "Results",
    "align",
    "close_loop",
    "correlate",
    "cycle_bounds",
    "diagnose",
    "export_results",
    "fetch_sample",
    "load_campaign",
    "plot_correlation",
    "plot_loop",
    "read_drivers",
    "read_record",
    "read_results",
    "reduce_record",
    "render_report",
    "results_schema",
    "run_campaign",
    "simulate_campaign",
]
