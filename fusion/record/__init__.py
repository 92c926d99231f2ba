"""L3, L4 - A record of sensors and channels over hours instead of a positioning test: the same effects, the same loop.

Read it in the order of the work: `blocks` (samples averaged), `effects` (what may be missing), `model` (tested under a drift of its own),
`prediction` (shrunken coefficients, hours ahead), `gates` (reasons not to name), `search`, `remainder` (what is left), `loop`.
"""
