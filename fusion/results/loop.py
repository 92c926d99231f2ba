"""Parts of results.json on the closed loop, along an axis and on a record: added effects, search, detection limits, residual.

A p-value of 0.001 stands for any smaller one (`fusion.results.parts.PValue`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from fusion.results.numbers import alike, measured, print_unit
from fusion.results.parts import Number, PValue, Quantity, ResultPart, Sensitivity, determined

Verdict = Literal["complete", "explained", "partial", "unexplained", "no_skill"]
#: What readings that an effect was not fitted to say of it; "no": they contradict it.
BorneOut = Literal["yes", "no", "cannot tell"]
#: Value of a parameter of an effect: a number in the unit that its name ends with, or a word.
Parameter = float | int | str
#: Range of a parameter that fits equally well: its ends (None where the data set none), or the other words.
Range = tuple[Number, ...] | tuple[str, ...]
#: Ratio of two errors of prediction up to which chance alone may make them differ.
ERROR_BY_CHANCE = 1.02


class Nothing(ResultPart):
    """An empty object: there is none."""


class RunnerUp(ResultPart):
    """The next best effect of a round of the search."""

    effect: str
    """Name of the effect."""
    gain_deficit: Number
    """Difference of its log-likelihood gain beyond chance to that of the chosen effect, nats."""
    p_value: PValue
    """Its own p-value, family-wise over the search."""


class Coefficient(Sensitivity):
    """A coefficient of an effect, fitted to all cycles."""

    unit: str
    """Unit of value and uncertainty."""
    prior: Number = None
    """What was expected beforehand; absent where nothing was."""
    prior_u: Number = None
    """Standard uncertainty of what was expected."""
    u_line: Number = None
    """The part of the line on the plan; absent where lines that fit as well as the declared one ask for about the same."""

    @property
    def expected_share(self) -> float:
        """Share of its value that was expected beforehand, 1; 0 where nothing was."""
        return 0.0 if self.prior is None else (self.fitted_u / determined(self.prior_u)) ** 2

    @property
    def expected(self) -> float:
        """What of its value was expected beforehand; 0 where nothing was."""
        return 0.0 if self.prior is None else self.expected_share * self.prior

    @property
    def moved_u(self) -> float:
        """Standard deviation by which it moves when a part of the test is left out; 0 where that is not looked at."""
        return 0.0


class DeclaredCoefficient(Coefficient):
    """A coefficient of a declared effect; that of ``axis_expansion`` with the share of its lagged copies: of an axis that has settled."""

    effect: str
    """Name of the effect."""
    jackknife_u: Number = None
    """Standard deviation by which it moves when a target or a part of the test is left out; null where it rests on one of them alone."""

    @property
    def moved_u(self) -> float:
        """The same, infinite where it rests on one of them alone."""
        return math.inf if self.jackknife_u is None else self.jackknife_u


class HeldOutError(ResultPart):
    """An error on the hold-out."""

    rmse_um: Number
    """Root mean square error, um."""


class ModelError(HeldOutError):
    """An error of the model on the hold-out, and what the model itself expects of it: where more is missed, the model is wrong there."""

    expected_um: Number = None
    """Root mean square error that drift, noise and coefficients make there, as uncertain as the training part leaves them, um; of the
    declared and final model of a record that of predicting later parts of the training part from earlier ones. Null in results of earlier
    versions."""
    expected_low_um: Number = None
    """Lower end of the range that holds the error in 95 % of such hold-outs where the model is right, um; null as its upper end."""
    expected_high_um: Number = None
    """Its upper end, um; null of the declared and final model of a record."""
    expected_p: Number = None
    """Probability of an error as large or larger where the model is right, by simulation; of a forecast from the last value by
    the distribution that its uncertainty states. Null as the range."""

    @property
    def exceeds(self) -> bool | None:
        """Whether it is larger than where the model is right; None where that is not known."""
        if self.rmse_um is None or self.expected_high_um is None:
            return None
        return self.rmse_um > self.expected_high_um


class ModelErrors(ResultPart):
    """Errors on the hold-out before and after."""

    declared: ModelError
    """Of the declared model."""
    final: ModelError
    """With the effects that the training part alone decided on, without those that left the forecast."""


class Baselines(ResultPart):
    """Errors of plain predictions of the hold-out from the training part."""

    last_value: HeldOutError
    """Repeating the last value."""
    mean: HeldOutError
    """The mean of the training part."""
    least_squares: HeldOutError
    """Least squares on everything that was logged."""
    ridge: HeldOutError
    """Ridge regression on the same."""
    ridge_with_lags: HeldOutError
    """Ridge regression on the same and on lagged copies of it."""


class RunBaselines(Baselines):
    """The same where a record has several runs."""

    mean_run: HeldOutError
    """The mean course of the other runs."""
    run_differences: HeldOutError | None = None
    """That course, and ridge regression of how a run differs from it on how what was logged differs; null for a single training run, and in
    results of earlier versions."""


class StepPart(ResultPart):
    """An effect that the closed loop added."""

    effect: str
    """Name of the effect."""
    event_time: str | None = None
    """Time of an event, UTC; null for an effect that lasts, and where no time of day is known."""
    parameters: Mapping[str, Parameter]
    """Parameters; a name ends with its unit."""
    parameter_ranges: Mapping[str, Range]
    """Values of the parameters that fit equally well (profile likelihood, 95 %)."""
    p_value: PValue
    """p-value that let it in, family-wise over the search."""
    rmse_before_um: Number
    """Root mean square error on the hold-out before it entered, um; null for an effect that entered after the hold-out was opened."""
    rmse_after_um: Number
    """Root mean square error on the hold-out after it entered, um; larger where the hold-out does not support it."""
    rmse_without_um: Number
    """Root mean square error on the hold-out of all other effects without it, um."""
    cross_rmse_before_um: Number
    """Error of predicting blocks of the whole test from the others, without it, um; of an event along an axis the block around it."""
    cross_rmse_after_um: Number
    """The same with it, um."""
    rms_um: Number
    """Root mean square of its contribution, um."""
    tied: tuple[str, ...]
    """Effects that these data cannot distinguish from it: together with it they are one answer, "one of these"."""
    lowers_error: bool = True
    """Whether readings that it was not fitted to, the hold-out or for an event blocks that are left out, are predicted better with it, by
    more than chance (2 %), and it did not leave the forecast."""
    withheld: str = ""
    """Why its name is not given although the readings follow its columns; empty where it is."""
    runner_up: RunnerUp | Nothing
    """The next best effect."""
    confirmed: bool
    """Whether readings that it was not fitted to bear it out; false: they contradict it, or cannot tell."""
    doubt: str
    """Why it is not borne out; empty where it is."""
    borne_out: BorneOut | None = None
    """Whether those readings, the hold-out or for an event blocks that are left out, bear it out; no: they contradict it. Either statement
    is false with a probability of 0.05. Null in results of earlier versions."""
    borne_out_p: PValue = None
    """Probability of a size as large there where the effect is not there."""
    borne_out_size: Number = None
    """Size with which it acts there over that predicted, 1: 1 where it is right, 0 where it is not there; null where it does not change."""
    borne_out_size_u: Number = None
    """Standard uncertainty of that."""
    borne_out_power: Number = None
    """Probability that these readings bear a right effect out."""
    confirmed_by: str
    """How it was confirmed before it entered."""

    @property
    def keeps_name(self) -> bool:
        """Whether readings that it was not fitted to bear it out, or do not contradict it and are predicted better with it; otherwise it
        stands in no headline and in no forecast.
        """
        if self.borne_out is None:
            return self.confirmed
        return self.borne_out == "yes" or (self.borne_out == "cannot tell" and self.lowers_error)


class AxisStep(StepPart):
    """An effect that the closed loop added along an axis."""

    coefficients: tuple[Coefficient, ...]
    """Coefficients of its columns."""
    held_out_p: PValue
    """p-value of its gain on readings that its coefficients were not fitted to."""
    event_cycle: int | None
    """Cycle in which an event happened; null for an effect that is no event."""


class RecordStep(StepPart):
    """An effect that the closed loop added on a record."""

    rms_by_channel_um: Mapping[str, Number]
    """Root mean square of its contribution, um, by channel."""
    chained_rmse_before_um: Number
    """Error of the forward-chained parts before it, um."""
    chained_rmse_after_um: Number
    """Error of the forward-chained parts with it, um."""
    rejected: Mapping[str, str]
    """Effects of the same round that were rejected, with the reason."""
    event_s: Number
    """Instant at which an event began, s from the start, by the raw readings; null for an effect that is no event. How long it took, and
    the ranges of both, are among the parameters."""
    sizes_um: Mapping[str, Quantity] = {}
    """Size of an event in every channel that takes part, um; empty for an effect that is no event, and in results of earlier versions."""

    @property
    def largest_sizes(self) -> list[tuple[str, Quantity]]:
        """These sizes by channel, the largest first."""
        return sorted(self.sizes_um.items(), key=lambda one: -abs(one[1].value or 0.0))


class DriftShare(ResultPart):
    """What a part of the drift follows."""

    effect: str
    """Name of the effect."""
    share: Number
    """Its share of the variance of the drift, 1, together with the others 1 less `unexplained.share`; negative where effects cancel."""


class Unexplained(ResultPart):
    """Structure that the final model leaves."""

    share: Number = None
    """Share of the variance of the drift that follows no effect of the model, 1; null in results of earlier versions."""

    shape: str
    """Description; empty where nothing is left."""
    rms_um: Number
    """Root mean square of what no named effect explains beyond the noise, um: the larger of the shape (along an axis over the readings,
    on a record and of an error of prediction what the hold-out error holds beside the noise) and the random drift that the model allows,
    0 where there is no shape; and, as the root of the sum of squares, of the added effects without a name."""
    p_value: PValue
    """p-value of any structure in the residual, family-wise over the shapes."""
    closest_effect: str
    """Effect that comes closest to it; empty where none does."""


class AxisUnexplained(Unexplained):
    """Structure that the final model leaves along an axis."""

    closest_effect_parameters: Mapping[str, Parameter] = {}
    """Its parameters: what it follows, and how late."""
    closest_effect_p: PValue
    """p-value of that effect in the search."""
    closest_effect_share: Number
    """Share of the structure that this effect explains, 1."""


class RecordUnexplained(Unexplained):
    """Structure that the final model leaves of a record."""

    p_values: Mapping[str, PValue]
    """p-value by shape, each shape by itself."""
    variance_share: Number
    """Share of the displacements' variance on the hold-out that is left, mean over the channels, 1."""


class ResidualDrift(ResultPart):
    """Stochastic drift of the model in addition to profile and effects."""

    kind: Literal["random walk", "integrated random walk"]
    """Stochastic model of this drift."""
    common_rms_um: Number
    """Root mean square of the part that all targets share, um."""
    stretch_rms_um: Number
    """Root mean square of the stretch at the far end of travel, um."""
    common_um_per_sqrt_h: Number = None
    """Process noise of the common part of a random walk, um/sqrt(h)."""
    stretch_um_per_sqrt_h: Number = None
    """Process noise of the stretch of a random walk, um/sqrt(h)."""
    common_um_in_1_h: Number = None
    """What the common part of an integrated random walk reaches in one hour, um."""
    stretch_um_in_1_h: Number = None
    """What the stretch of an integrated random walk reaches in one hour, um."""


class NoisePart(ResultPart):
    """Noise of a single reading: what neighbouring readings and successive cycles share of it."""

    reading_um: Number
    """Standard deviation, um."""
    shared_share: Number
    """Share of its variance that neighbouring readings of a pass share, 1."""
    correlation_time_s: Number
    """Time over which that share falls to 37 %, s; null where nothing is shared."""
    cycle_correlation: Number
    """Correlation of a reading with that of the cycle before at the same place and approach, 1."""


class HoldOutQuestion(ResultPart):
    """Hold-out test of the strongest undecided candidate."""

    effect: str
    """Name of the effect."""
    parameters: Mapping[str, Parameter]
    """Parameters; a name ends with its unit."""
    rmse_before_um: Number
    """Root mean square error on the hold-out without it, um."""
    rmse_after_um: Number
    """Root mean square error on the hold-out with it, um."""
    p_value: PValue
    """p-value of its gain on the hold-out."""
    entered: bool
    """Always false: the hold-out reports, it does not decide."""


class CandidateScore(ResultPart):
    """Best candidate of one effect in one round of the search."""

    effect: str
    """Name of the effect."""
    parameters: Mapping[str, Parameter]
    """Parameters of the best candidate; empty where none is separable from the model."""
    gain: Number
    """Gain in log-likelihood, nats."""
    excess_gain: Number
    """Gain beyond the mean gain where nothing is missing, nats."""
    p_value: PValue
    """p-value of the gain for this effect alone."""
    family_wise_p: PValue
    """p-value of the gain, family-wise over the search."""


class AxisScore(CandidateScore):
    """Best candidate of one effect along an axis."""

    held_out_gain: Number
    """Gain on readings that its coefficients were not fitted to, nats."""
    held_out_p: PValue
    """p-value of that gain."""
    collinear_share: Number
    """Share of the candidates that are collinear with the model, 1."""


class RecordScorePart(CandidateScore):
    """Best candidate of one effect on a record."""

    chained_rmse_before_um: Number
    """Error of the forward-chained parts before the round, um."""
    chained_rmse_after_um: Number
    """Error of the forward-chained parts with it, um; null where it was not tried."""
    chosen: bool
    """Whether it entered the model."""
    rejected: str
    """Why it did not enter; empty where it did or was not tried."""


class DetectionLimit(ResultPart):
    """How large an effect must be to be detected with these readings."""

    effect: str
    """Name of the effect."""
    detectable_um: Number
    """Root mean square detected with 80 % power, median over the candidates, um; null where none is separable from the model."""
    best_um: Number
    """The same for the candidate that is easiest to detect, um."""
    worst_um: Number
    """The same for the candidate that is hardest to detect, um."""
    visible_share: Number
    """Share of the effect's root mean square that is not absorbed by profile and declared effects, 1; null where it does not vary."""
    confounded_with: tuple[str, ...]
    """Effects that are collinear with what is visible of it."""
    note: str
    """What prevents its detection; empty where nothing does."""


class FieldCorrection(ResultPart):
    """An error of the camera that was corrected in the fields."""

    effect: str
    """``camera_offset`` or ``reflected_source``."""
    text: str
    """What was wrong, in one sentence."""
    size_K: Number
    """Largest size of the error, K."""
    size_u_K: Number
    """Standard uncertainty of the size, K."""
    first_cycle: int
    """First cycle whose field it touches."""


class AxisLine(ResultPart):
    """The declared line on the plan against its best alternative."""

    alternative: str
    """The alternative in words."""
    gain: Number
    """What it gains in log-likelihood, less a penalty for added effects, nats; negative where the declared line is better."""
    gain_limit: Number
    """What an alternative gains by chance in two of a thousand tests with the declared line, nats."""
    expansion_ppm_per_K: Number
    """Expansion along the alternative, estimated from the readings alone, ppm/K."""
    expansion_u_ppm_per_K: Number
    """Its standard uncertainty, ppm/K."""
    superfluous: tuple[str, ...]
    """Added effects that are not needed with the alternative."""
    alternative_ppm_per_K: tuple[Number, Number]
    """Smallest and largest expansion along lines that explain the readings as well as the declared one, ppm/K."""


class ResidualPart(ResultPart):
    """Tests of the residual of one model."""

    p_values: Mapping[str, PValue]
    """p-value by shape (permutation test), each shape by itself."""
    drift_common_um: Number
    """Root mean square of the unexplained drift that all targets share, um."""
    drift_stretch_um: Number
    """Root mean square of the unexplained stretch at the far end of travel, um."""
    event_s: Number
    """Instant of the strongest shift, s from the first reading."""
    period_min: Number
    """Period of the strongest periodic component, min."""
    period_is_cycle: bool
    """Whether that period is the cycle's own or a part of it."""


class ResidualTestsPart(ResultPart):
    """Tests of the residual before and after the closed loop."""

    declared: ResidualPart
    """Residual of the declared model."""
    final: ResidualPart
    """Residual of the final model."""


class HoldOutErrors(ResultPart):
    """Root mean square errors on the hold-out, of a record means over the channels; null where nothing is held out."""

    rmse_persistence_um: Number
    """Of repeating the last value, in a run of a record its zero, um."""
    rmse_declared_um: Number
    """Of the declared model, um."""
    rmse_final_um: Number
    """Of the final model, with the effects that the training part alone decided on, um."""


class Tracking(ResultPart):
    """Errors on the hold-out where all channels, or all targets, are read again from time to time."""

    every_min: Number
    """Time from one reading to the next, min."""
    model: HeldOutError
    """Of the final model, its random drift carried on from the readings by the Kalman filter."""
    last_reading: HeldOutError
    """Of repeating the last reading."""
    ridge: HeldOutError
    """Of ridge regression started at the last reading."""


class Anchored(ResultPart):
    """Errors on the hold-out of a record of one run where the last values before it are known, and the readings since."""

    model: ModelError
    """Of the responses to all sensors and drivers, at once and late, that `export` gives to a control."""
    last_value: HeldOutError
    """Of staying at the last values."""


class Loop(HoldOutErrors):
    """What the closed loop found, along an axis or on a record."""

    declared: tuple[str, ...]
    """Declared effects."""
    held_out: str
    """What was held out."""
    noise_floor_um: Number
    """Standard deviation of a single reading or block mean that no model explains, um."""
    errors: ModelErrors
    """The errors before and after, with what the model itself expects."""
    baselines: RunBaselines | Baselines
    """Errors of plain predictions."""
    best_baseline: Literal[
        "last_value", "mean", "least_squares", "ridge", "ridge_with_lags", "mean_run", "run_differences"
    ]
    """Name of the plain prediction with the smallest error, chosen on the hold-out itself."""
    steps: tuple[StepPart, ...]
    """Effects that were added, in turn."""
    separable: bool = True
    """Whether a cause can be named: false where ridge regression with lagged copies predicts the hold-out better by a quarter."""
    warm_up_only: tuple[str, ...] = ()
    """Declared effects that the readings show by one warm-up alone: their coefficients, with their uncertainty, and the verdict hold on
    condition that nothing else warmed alike, because whatever did is contained in them."""
    drift_um: Number = None
    """Root mean square of the drift, about the mean of every position or channel, um: along an axis without the noise; null in results of
    earlier versions."""
    followed: tuple[DriftShare, ...] = ()
    """What the drift follows: declared effects, then added ones that are not contradicted."""
    wandering_um: Number = None
    """Root mean square of the random drift that the final model allows beside its effects, um; null in results of earlier versions."""
    verdict: Verdict
    """complete: nothing is missing; explained: effects added, nothing is left; partial: something is left; unexplained: something is left
    and no effect deserves its name; no_skill: the model predicts no better than the last value or the mean, these data cannot tell."""
    unconfirmed_effects: Mapping[str, PValue]
    """Effects that are significant and were not admitted or not confirmed, with their p-value."""
    tracking: Tracking | None = None
    """Errors with a reading from time to time; null for several runs, and in results of earlier versions."""
    left_out_of_forecast: tuple[str, ...] = ()
    """Added effects without which the final error is predicted: the hold-out contradicts them, or is predicted no better with them."""
    unexplained: Unexplained
    """What is left."""
    not_tried: Mapping[str, str]
    """Effects that were not tried, with the reason."""
    not_admitted: Mapping[str, str]
    """Effects that were tried and not admitted, with the reason."""

    @property
    def named(self) -> tuple[StepPart, ...]:
        """The added effects that keep their name, where a cause can be separated."""
        return tuple(one for one in self.steps if self.separable and one.keeps_name)

    def rows(self) -> list[tuple[str, str]]:
        """Return names and texts of what was found, in short."""
        errors = (self.errors.declared.rmse_um, self.errors.final.rmse_um)
        return [
            ("verdict", self.verdict.replace("_", " ")),
            ("added effects", ", ".join(step.effect for step in self.steps) or "none"),
            ("held-out error", f"{' -> '.join(alike(errors, distinct=False))} µm"),
        ]

    def __str__(self) -> str:
        return "\n".join(f"{name}: {text}" for name, text in self.rows())

    __repr__ = __str__


class AxisLoop(Loop):
    """What the closed loop found along an axis."""

    declared_coefficients: tuple[DeclaredCoefficient, ...]
    """Coefficients of the declared effects."""
    steps: tuple[AxisStep, ...]
    """Effects that were added, in turn."""
    unexplained: AxisUnexplained
    """What is left."""
    residual_drift: ResidualDrift
    """Drift without a cause in the final model."""
    noise: NoisePart | None = None
    """Noise of the final model; null in results of earlier versions."""
    held_out_test: HoldOutQuestion | Nothing = Nothing()
    """Hold-out test of the strongest undecided candidate, in results of earlier versions."""
    search: tuple[tuple[AxisScore, ...], ...]
    """Scores of every round of the search."""
    identifiability: tuple[DetectionLimit, ...]
    """Detection limits of the effects."""
    field_corrections: tuple[FieldCorrection, ...]
    """Errors of the camera that were corrected in the fields."""
    residual_tests: ResidualTestsPart
    """Tests of the residual."""
    axis_line: AxisLine | None = None
    """Other lines, orders of the targets and signs; null where the expansion of the axis is not declared."""

    def rows(self) -> list[tuple[str, str]]:
        """Return the coefficients with U (k = 2), then what was found."""
        told = ((one.effect, measured(one.value, one.u, print_unit(one.unit))) for one in self.declared_coefficients)
        return [*told, *super().rows()]


class ChannelErrors(HoldOutErrors):
    """Errors of one channel of a record on the hold-out."""

    noise_um: Number
    """Standard deviation of a block mean that no model explains, um."""
    variance_share: Number
    """Share of the displacement's variance on the hold-out that is left, 1."""
    rmse_anchored_um: Number = None
    """Of predicting from the last value before the hold-out, with the readings since, um; null for several runs, and in results of earlier
    versions."""
    expected_anchored_um: Number = None
    """What that forecast itself expects of it, um; null as above."""


class ChainedPart(HoldOutErrors):
    """One part of a record, predicted by the whole procedure on the time before it."""

    first_h: Number
    """Start of the part, h."""
    last_h: Number
    """End of the part, h."""
    in_training: bool
    """Whether it is before the hold-out, so that it took part in the selection of effects."""
    effects: tuple[str, ...]
    """Effects found before it, or in the other runs."""
    runs: tuple[str, ...] = ()
    """Names of the runs that it consists of; absent in a record of one run."""


class SensorFaultPart(ResultPart):
    """A temperature sensor or a displacement that is faulty or suspected."""

    sensor: str
    """Name of the sensor, or of the displacement."""
    kind: Literal["no signal", "stuck", "jump", "ramp", "noise", "glitch", "erratic", "clipped", "computed"]
    """What it does; the last two only displacements do."""
    quantity: Literal["temperature", "displacement"] = "temperature"
    """Whether it is a temperature sensor or a displacement; absent of a temperature sensor."""
    state: Literal["left_out", "readings_left_out", "suspected"]
    """Whether it was left out of the whole record, its readings at fault alone, or nothing because a machine may do the same."""
    readings: int = 0
    """Readings that were left out; absent where it is all of them or none."""
    stretches_s: tuple[tuple[Number, Number], ...] = ()
    """Times of the first and last reading of every stretch of these, s, counted as the onset; absent as above."""
    computed_with: str = ""
    """The faulty sensor that the displacement is computed with; absent where it is not."""
    run: str = ""
    """Run that shows it; absent in a record of one run."""
    onset_s: Number
    """When it began, s from the start, of several runs from the start of that run."""
    onset_u_s: Number
    """Standard uncertainty of that, s."""
    size: Number
    """Change beyond what the other sensors predict, K; of noise the ratio after to before; of readings the largest, K or um; else null."""
    ratio: Number
    """Its largest excursion over the next largest; of a computed displacement the error without the sensor over that with it; else null."""
    limit: Number
    """Ratio from which it is named; null as above."""
    reason: str
    """Why it is suspected only; empty for one that was left out."""
    rmse_with_um: Number
    """Error of the declared model with it, um, later parts of the training time predicted from those before; null for one that stays,
    that is silent, or that failed after that time. Of a displacement its own error; of a computed one with its faulty sensor.
    """
    rmse_without_um: Number
    """The same without all that was left out, um, never larger for a sensor; of a computed one with its sensor as it would be without the
    fault; null as above.
    """


class RunPart(HoldOutErrors):
    """One run of a record of several."""

    file: str
    """Name of its table."""
    held_out: bool
    """Whether it is held out."""
    duration_h: Number
    """Its length, h."""
    blocks: int
    """Number of its blocks."""
    verdict: Verdict | Literal[""]
    """Verdict by the errors in this run; empty where it is not held out."""


class RecordLoop(Loop):
    """What the closed loop found on a record; errors are means over the channels."""

    steps: tuple[RecordStep, ...]
    """Effects that were added, in turn."""
    unexplained: RecordUnexplained
    """What is left."""
    channels: Mapping[str, ChannelErrors]
    """Errors by channel."""
    anchored: Anchored | None = None
    """Errors from the last values before the hold-out, with the readings since; null for several runs, each of which is predicted from its
    own zero anyway, and in results of earlier versions."""
    chained: tuple[ChainedPart, ...]
    """Forward-chained parts."""
    search: tuple[tuple[RecordScorePart, ...], ...]
    """Scores of every round of the search."""
    sensor_faults: tuple[SensorFaultPart, ...] = ()
    """Sensors and displacements that are faulty or suspected, examined before any model."""
    runs: tuple[RunPart, ...] = ()
    """Runs of a record of several; absent where there is one."""

    @property
    def named(self) -> tuple[StepPart, ...]:
        """The added effects that keep their name, that which moves the channels most first."""
        return tuple(sorted(super().named, key=lambda one: -(one.rms_um or 0.0)))
