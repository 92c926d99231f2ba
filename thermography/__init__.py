"""Thermograms of a machine table: FLIR files to counts, temperature, table plan, and one temperature field per measurement cycle.

Levels of the data: as recorded (:mod:`thermography.io`), calibrated (:mod:`thermography.radiometry`), located on the plan
(:mod:`thermography.registration`), reduced to fields (:mod:`thermography.fields`). A short way through them::

    frames, left_out = index_frames(sorted(Path("thermal").glob("*.jpg")))
    frame = frames[0].read()
    registration = register(calibrate(frame.counts, frame.parameters), read_fiducials("fiducials.csv"), grid=grid)
    fields = reduce_frames(frames, registration, grid, cycle_bounds)
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
