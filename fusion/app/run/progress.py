"""How far a run is, stage by stage, and how long the present one still takes."""

from __future__ import annotations

from dataclasses import dataclass, field

from fusion.report.wording import duration


@dataclass(frozen=True)
class Stage:
    """One step of a run.

    Attributes
    ----------
    label : str
        Its name.
    done, total : int
        Finished parts and their number.
    started_s, now_s : float, s
        When it began, and when `done` was told; of any clock that only advances.
    """

    label: str
    done: int
    total: int
    started_s: float
    now_s: float

    @property
    def share(self) -> float:
        """Finished share, 0 to 1."""
        return min(self.done / self.total, 1.0) if self.total else 1.0

    @property
    def words(self) -> str:
        """How far it is: the time that it took, or the time that is left at the speed so far."""
        elapsed = self.now_s - self.started_s
        if self.share >= 1.0:
            return f"done in {duration(elapsed)}" if elapsed >= 1.0 else "done"
        if self.done == 0:
            return "under way"
        left = elapsed / self.done * (self.total - self.done)
        return f"{self.done} of {self.total}, about {duration(max(left, 1.0))} left"


@dataclass
class Progress:
    """All steps of a run in the order in which they began.

    Attributes
    ----------
    stages : dict of str to Stage
        By name.
    """

    stages: dict[str, Stage] = field(default_factory=dict)

    def take(self, label: str, done: int, total: int, now_s: float) -> None:
        """Note that a step is so far.

        Parameters
        ----------
        label : str
            Step of the work.
        done, total : int
            Finished parts and their number.
        now_s : float, s
            Present time.
        """
        known = self.stages.get(label)
        begun = now_s if known is None or done < known.done else known.started_s
        self.stages[label] = Stage(label, done, total, begun, now_s)
