"""The analysis, as pure functions: one clock, checks of the inputs, attribution, effects, model of the drift, diagnosis (level: fused)."""
