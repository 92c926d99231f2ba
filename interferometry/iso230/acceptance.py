"""Whether a quantity keeps its tolerance, with its uncertainty."""

from __future__ import annotations

from typing import Literal

Decision = Literal["pass", "fail", "not decided within the uncertainty"]


def decide(value: float, expanded_u: float, limit: float) -> Decision:
    """Judge a quantity against its upper limit.

    Parameters
    ----------
    value, expanded_u, limit : float
        Quantity, its expanded uncertainty U (k = 2) and its tolerance, in one unit.

    Returns
    -------
    {"pass", "fail", "not decided within the uncertainty"}
        Pass where the quantity and its uncertainty lie within the limit, fail where both lie beyond it.

    References
    ----------
    ISO 14253-1, decision rules for verifying conformity or nonconformity with specifications: the uncertainty counts against whoever
    claims the result.

    Examples
    --------
    >>> decide(8.0, 1.5, 10.0), decide(9.0, 1.5, 10.0), decide(12.0, 1.5, 10.0)
    ('pass', 'not decided within the uncertainty', 'fail')
    """
    if value + expanded_u <= limit:
        return "pass"
    return "fail" if value - expanded_u > limit else "not decided within the uncertainty"
