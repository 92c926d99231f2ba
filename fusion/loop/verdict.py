"""What the evidence allows to say: is a name confirmed, has the model skill, and the one word for the outcome.

The hold-out set has no say in what enters a model. It says whether what entered is borne out, and whether the model predicts at all.
"""

from __future__ import annotations

from fusion.products.results_loop import Verdict

#: An effect is confirmed where it takes at least this share from the squared error beyond the noise, 2 % of the error itself: a model that
#: follows chance changes an error by less than that either way.
GAIN_SHARE = 0.04


def is_confirmed(with_um: float, without_um: float, noise_um: float) -> bool:
    """Whether a prediction is better with an effect by more than chance changes it.

    Parameters
    ----------
    with_um, without_um : error of predicting readings that the coefficients were not fitted to, with the effect and without it, um
    noise_um : noise of one of these readings, which no effect can take away, um
    """
    beyond_noise = max(0.0, without_um**2 - noise_um**2)
    return with_um < without_um and without_um**2 - with_um**2 >= GAIN_SHARE * beyond_noise


def doubt_of(with_um: float, without_um: float, noise_um: float, where: str) -> str:
    """Why an effect is not confirmed, in words; empty where it is.

    Parameters
    ----------
    with_um, without_um, noise_um : as for :func:`is_confirmed`
    where : what was predicted
    """
    if is_confirmed(with_um, without_um, noise_um):
        return ""
    return f"the error {where} is {without_um:.3g} µm without it and {with_um:.3g} µm with it"


def exceeds_noise(error_um: float, noise_um: float, share: float) -> bool:
    """Whether an error holds more than noise.

    Parameters
    ----------
    error_um : root mean square, um
    noise_um : noise of a single reading, um
    share : what the error may hold beside the noise, as a multiple of it
    """
    return error_um**2 > (1.0 + share**2) * noise_um**2


def has_skill(error_um: float, last_value_um: float, mean_um: float, noise_um: float, share: float) -> bool:
    """Whether a model predicts the hold-out set better than the last value and the mean of the training part do.

    Parameters
    ----------
    error_um : of the model on the hold-out set, um
    last_value_um, mean_um : errors of repeating the last value and the mean, um
    noise_um, share : as for :func:`exceeds_noise`; where the error is that of the noise there is nothing left to be predicted
    """
    return error_um < min(last_value_um, mean_um) or not exceeds_noise(error_um, noise_um, share)


def verdict(*, confirmed: bool, doubtful: bool, tested: bool, remains: bool, skill: bool) -> Verdict:
    """Word for the outcome.

    Parameters
    ----------
    confirmed : whether effects were added and confirmed
    doubtful : whether effects were added and not confirmed
    tested : whether a test shows that something is left: a shape in the residual, or a significant effect without a name
    remains : whether an error or a drift is left that is large beside the noise
    skill : whether the model predicts better than the last value and the mean

    Returns
    -------
    Verdict
        Without skill the data say that nothing is missing, or what it was, in no case; that something is left they say where a test does.
    """
    if not skill and not tested:
        return "no_skill"
    left = doubtful or tested or remains
    if confirmed:
        return "partial" if left else "explained"
    return "unexplained" if left else "complete"
