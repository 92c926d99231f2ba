"""A record of temperature sensors and displacement channels over hours: the same effects and the same closed loop (level 4).

In the order of the work: `blocks` (samples averaged), `hold_out`, `effects` (candidates), `model` (every channel under its own drift),
`prediction` (shrunken coefficients, hours ahead), `grounds` (admissibility), `problem` (what the loop asks), `loop`, `remainder`, `result`.
"""
