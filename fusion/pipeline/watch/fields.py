"""Mean field of every finished cycle on the plan, for a first look: what `thermofuse run` does to all frames comes after the test."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
import xarray as xr

from fusion.campaign.config import Campaign
from fusion.pipeline.radiometry import overridden_parameters
from thermography.errors import ThermographyError
from thermography.fields.blocks import BLOCK_FRAMES, reduce_block
from thermography.fields.following import Registrations
from thermography.fields.moving import reduce_moving_frames
from thermography.io.frame import FrameReference
from thermography.radiometry.overrides import Overrides
from thermography.radiometry.planck import calibrate
from thermography.registration.displacement import RegistrationSpan
from thermography.registration.lens import read_lens
from thermography.registration.picture import picture_grid, register_picture
from thermography.registration.plan import PlanGrid, read_fiducials
from thermography.registration.register import Registration, register

#: First frames whose mean is registered.
_REGISTRATION_FRAMES = 5
#: From this displacement of the fiducials on the table or the camera has moved, px.
_MOVED_PX = 1.0


class FieldsOfCycles:
    """Reduces the frames of one cycle after the other.

    Parameters
    ----------
    campaign : Campaign
        With ``[thermography]`` and ``[plan]``.
    """

    def __init__(self, campaign: Campaign) -> None:
        thermography, plan = campaign.thermography, campaign.plan
        assert thermography is not None and plan is not None
        self._plan = plan
        self._moving = thermography.table == "moving"
        self._direction = None if plan.axis is None else plan.axis.direction
        self._override = Overrides(overridden_parameters(thermography))
        self._fiducials = [] if plan.fiducials is None else read_fiducials(campaign.resolve(plan.fiducials))
        self._lens = None if thermography.lens is None else read_lens(campaign.resolve(thermography.lens))
        self._grid: PlanGrid | None = None
        self._registration: Registration | None = None
        self._registrations: Registrations | None = None
        self._tried, self._wait = 0, 1

    @property
    def grid(self) -> PlanGrid:
        """Cells of the plan; of a plan that is the picture, once a frame was seen."""
        assert self._grid is not None
        return self._grid

    def reduce(self, frames: Sequence[FrameReference]) -> tuple[xr.DataArray | None, tuple[str, ...]]:
        """Return the mean temperature of a cycle's frames on the plan.

        Parameters
        ----------
        frames : sequence of FrameReference
            Frames of the cycle by time.

        Returns
        -------
        (y, x) DataArray or None
            degC; None where the plan is not registered yet or no frame can be used.
        tuple of str
            Why, or that the table has moved.
        """
        if not frames:
            return None, ("no frame in this cycle",)
        try:
            registration = self._register(frames)
            if registration is None:
                return None, ()
            usable = [frame for frame in frames if frame.shape == registration.shape]
            if not usable:
                return None, ("the frames of this cycle have another size than the first ones",)
            return self._moving_field(usable, registration) if self._moving else self._still_field(usable)
        except (ThermographyError, OSError) as error:
            return None, (str(error),)

    def _register(self, frames: Sequence[FrameReference]) -> Registration | None:
        """Register the plan on the first frames; where that fails it is tried again in ever fewer cycles, because it takes long."""
        if self._registration is not None:
            return self._registration
        self._tried += 1
        if self._tried < self._wait:
            return None
        self._wait = 2 * self._tried
        first = [frame for frame in frames if frame.shape == frames[0].shape][
            : 1 if self._moving else _REGISTRATION_FRAMES
        ]
        reference = np.mean([calibrate(frame.read_counts(), self._override(frame)) for frame in first], axis=0)
        plan = self._plan
        if plan.in_pixels:
            self._grid = picture_grid(reference.shape, plan.cell_px)
            registration = register_picture(reference.shape)
        else:
            assert plan.size_mm is not None and plan.cell_size_mm is not None
            self._grid = PlanGrid(*plan.size_mm, plan.cell_size_mm)
            registration = register(reference, self._fiducials, grid=self._grid, lens=self._lens)
        self._registrations = Registrations([RegistrationSpan(0, registration)], self.grid)
        self._registration = registration
        return registration

    def _still_field(self, frames: Sequence[FrameReference]) -> tuple[xr.DataArray, tuple[str, ...]]:
        assert self._registrations is not None
        sensor = self._registrations.sensors[0]
        total, count, moved = np.zeros((len(self.grid.y_mm), len(self.grid.x_mm))), 0, 0.0
        for parameters, group in groupby(frames, key=self._override):
            alike = list(group)
            for start in range(0, len(alike), BLOCK_FRAMES):
                block = alike[start : start + BLOCK_FRAMES]
                result = reduce_block(block, parameters, sensor)
                total += len(block) * result.cells
                count += len(block)
                shifts = np.hypot(*result.displacement_px[:, :2].T)
                moved = max(moved, float(np.nanmedian(shifts)) if np.isfinite(shifts).any() else 0.0)
        warnings = (f"table or camera has moved by {moved:.1f} px since the first frames",) if moved > _MOVED_PX else ()
        return self._named(total / count), warnings

    def _moving_field(
        self, frames: Sequence[FrameReference], registration: Registration
    ) -> tuple[xr.DataArray, tuple[str, ...]]:
        bounds = np.array([[frames[0].time, frames[-1].time + np.timedelta64(1, "ms")]], "datetime64[ns]")
        fields = reduce_moving_frames(
            frames, registration, self.grid, bounds, direction=self._direction or (1.0, 0.0), override=self._override
        )
        return self._named(fields["temperature"].values[0]), ()

    def _named(self, values: np.ndarray) -> xr.DataArray:
        attributes = {"units": "degC", "units_metadata": "temperature: on_scale"}
        return xr.DataArray(
            values, dims=("y", "x"), coords={"y": self.grid.y_mm, "x": self.grid.x_mm}, attrs=attributes
        )
