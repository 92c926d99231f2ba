"""Contract of the products of `thermography`: dims, units and kinds of the variables that other packages may rely on."""

from __future__ import annotations

#: Name of a variable -> (dims, units, kind), kind being a NumPy dtype kind (``f``, ``i``, ``u``, ``M``).
Contract = dict[str, tuple[tuple[str, ...], str, str]]

#: Fields on the table plan; ``x`` and ``y`` are plan coordinates in mm, ``cycle`` counts from 1.
FIELDS: Contract = {
    "temperature": (("cycle", "y", "x"), "degC", "f"),
    "temperature_u": (("cycle", "y", "x"), "K", "f"),
    "temperature_noise_u": (("cycle", "y", "x"), "K", "f"),
    "temperature_rise": (("cycle", "y", "x"), "K", "f"),
    "temperature_rise_u": (("cycle", "y", "x"), "K", "f"),
    "temperature_rise_noise_u": (("cycle", "y", "x"), "K", "f"),
    "rise_scale_u": (("y", "x"), "1", "f"),
    "temperature_spread": (("cycle", "y", "x"), "K", "f"),
    "count": (("cycle", "y", "x"), "1", "i"),
    "cycle_time": (("cycle",), "", "M"),
    "frame_temperature": (("time", "y", "x"), "degC", "f"),
}
