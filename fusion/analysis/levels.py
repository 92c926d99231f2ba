"""Probabilities at which a run states what is not there.

A run may state effects, a remainder and positions that stand out: ENTRY + REMAINDER + POSITION are the 0.05 of a whole run.
"""

#: Family-wise, of the verdicts on drift and field.
ATTRIBUTION_LEVEL = 0.05
#: Number of simulated series on which the false alarm rate of these verdicts is measured.
CHECKS = 199
#: Shares of the probability of adding an effect under the null hypothesis, over everything that is tried (2.5 %): the search, and the
#: second look. Every effect that is found opens the search again with the same probability, and a campaign may lack two: half of the 5 %
#: that a wrong name may have.
SEARCH_LEVEL, SECOND_LEVEL = 0.02, 0.005
ENTRY_LEVEL = SEARCH_LEVEL + SECOND_LEVEL
#: The same on a record, where only drift and noise act. A drift that wanders at random is a stand-in for what a real machine does, and
#: its sensors are late, so the probability is smaller than along an axis: that of an error of three standard deviations.
RECORD_ENTRY_LEVEL = 0.001
#: Of reporting a shape where none is left, over all statistics together.
REMAINDER_LEVEL = 0.01
#: Of any position that is said to stand out.
POSITION_LEVEL = 0.015
#: Of taking another line on the plan for the declared one, over all lines that are tried.
LINE_LEVEL = 2e-3
#: Of naming any sensor of a sound record.
SENSOR_LEVEL = 0.01
#: Of the bootstrap tests of a cause; local temperature is the cause that costs most when it is wrong.
CAUSE_LEVELS = {"step": 0.05, "local_temperature": 0.02}
#: At which the jumps of a link have a course in time, so that they are no lost motion from pass to pass.
LINK_COURSE_LEVEL = 0.01
#: Above which a serial p-value is called not significant in a sentence; it takes no part in the choice of the cause.
SERIAL_LEVEL = 0.05
#: Of saying that campaigns of one machine differ, over everything that is compared.
CHANGE_LEVEL = 0.05
#: That an effect which is absent passes its confirmation; the multiplicity of the search is accounted for before.
CONFIRMATION_LEVEL = 0.1
#: Of evidence so strong that an inconclusive confirmation does not stop it: few switchings of a load leave early blocks undecided.
STRONG_LEVEL = 0.001
#: From which on an effect by itself is no rival of the one that was added.
RIVAL_LEVEL = 0.05
#: Of bearing out any effect that is not there, and of contradicting any that is, over all effects of a model.
ANSWER_LEVEL = 0.05
#: That a right effect is denied its name, because its pattern along the axis is another, or its size on unseen readings.
DENIAL_LEVEL = 0.001
