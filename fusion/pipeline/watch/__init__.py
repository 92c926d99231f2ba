"""A test while it runs: files that grow, cycles that are finished, and what they show so far."""

from fusion.pipeline.watch.follow import follow
from fusion.pipeline.watch.state import Enough, FinishedCycle, LiveState, live_line

__all__ = ["Enough", "FinishedCycle", "LiveState", "follow", "live_line"]
