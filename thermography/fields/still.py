"""Fields of a still table: one per cycle, and one per frame or short block of frames, on the table plan.

Stretches of frames are reduced in parallel and gathered in order. Every frame is compared with its registration; after a lasting
displacement of camera or table (a knock) the plan is registered again, and the frames from there on are cut into blocks again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from thermography.common import Array, ThermographyError
from thermography.fields.blocks import (
    NO_CYCLE,
    Block,
    BlockResult,
    FrameSeries,
    Override,
    ReductionError,
    RegisteredSensor,
    Registrations,
    cut_blocks,
    make_frame_series,
    reduce_block,
)
from thermography.fields.cycle_fields import CyclePart, assemble_fields
from thermography.fields.objects import Obstructions
from thermography.fields.scheduling import Pool, in_order, open_pool
from thermography.io.files import write_atomically
from thermography.io.frame import CameraParameters, FrameReference
from thermography.large_arrays import Spool, fill_array
from thermography.radiometry.averaging import MeanTemperature
from thermography.radiometry.camera import Detector
from thermography.registration.displacement import (
    KNOCK_PX,
    SUSPECT_PX,
    RegistrationSpan,
    fiducial_displacement,
    image_displacement,
    register_after_knock,
    search_displacement,
    shift_registration,
    zoom_and_turn,
)
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration

# Finished cycles of a reduction on disk, to resume an interrupted run.

_DESCRIPTION = "reduction.json"
_OPEN_CYCLE = "open"
#: Of the pixels of a cycle that is open.
_PIXELS = ("mean", "variance", "bound_K")


class CheckpointError(ThermographyError):
    """A checkpoint does not belong to this reduction; the message names it and the remedy."""


class Checkpoint:
    """A folder to which finished cycles are written, each file complete or absent, with a description of everything on which they depend;
    raises a CheckpointError where it holds cycles of another reduction.
    """

    def __init__(self, folder: str | Path, description: dict[str, Any]) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(description, sort_keys=True, default=str)
        path = self.folder / _DESCRIPTION
        if path.exists() and path.read_text(encoding="utf-8") != text:
            before = json.loads(path.read_text(encoding="utf-8"))
            differs = sorted(key for key in description if json.loads(text).get(key) != before.get(key))
            raise CheckpointError(
                f"{self.folder}: holds cycles of another reduction (other {', '.join(differs) or 'content'}); remove the folder to restart"
            )
        write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))

    def save(self, name: str, **arrays: Any) -> None:
        """Write arrays, numbers and times by their names, in place of what has been saved under the same name."""
        write_atomically(self.folder / f"{name}.npz", lambda temporary: np.savez(temporary, **arrays))

    def load(self, names: str) -> Iterator[dict[str, Any]]:
        """Yield what was saved under the names of a pattern, in their order."""
        for path in sorted(self.folder.glob(f"{names}.npz")):
            with np.load(path) as stored:
                yield {
                    name: array[()] if array.ndim or array.dtype.kind == "M" else array.item()
                    for name, array in stored.items()
                }


def describe_reduction(
    frames: FrameSeries, grid: PlanGrid, spans: Sequence[RegistrationSpan], *, block_s: float
) -> dict[str, Any]:
    """Describe a reduction by everything on which its result depends."""
    digest = hashlib.sha256()
    # Most frames share their parameters: their text is made once.
    texts: dict[CameraParameters, str] = {}
    for reference in frames.references:
        camera = frames.override(reference)
        if camera not in texts:
            texts[camera] = str(camera)
        digest.update(f"{reference.path.name}#{reference.index}@{reference.time}|{texts[camera]}".encode())
    digest.update(np.ascontiguousarray(frames.correction_K, float).tobytes())
    digest.update(frames.detector.flags.tobytes() + f"{frames.detector.lowest} {frames.detector.highest}".encode())
    matrices = [(span.first_frame, span.registration.projection.plan_to_sensor.tolist()) for span in spans]
    return {
        "frames": digest.hexdigest(),
        "cycles": frames.bounds.astype(str).tolist(),
        "plan": asdict(grid),
        "registrations": [{"first": first, "plan_to_sensor": matrix} for first, matrix in matrices],
        "block_s": block_s,
    }


# A still table followed over the frames: their displacements, and a registration after every knock.

#: Largest number of frames whose mean is registered after a knock, or examined where single frames have too little contrast.
_MEAN_FRAMES = 8
#: A displacement lasts if the first measurable one of this number of following frames shares it.
_FOLLOWING_FRAMES = 3
#: Frames before a lasting displacement that show whether it had begun.
_CREPT_FRAMES = 3


@dataclass(frozen=True)
class Knock:
    """A lasting displacement (column, row, growth, turn), px, from a frame on, in a registration span; shown by the image of the table
    where the fiducials have no contrast.
    """

    frame: int
    span: int
    displacement_px: Array
    by_image: bool


class Displacements:
    """Displacement of every frame against its registration, root mean square of the fiducials (frames,), px, NaN where it is not measured;
    frames that are displaced alone; and the bias of the fiducial monitor from temperature gradients on the table, (4,) px.
    """

    def __init__(self, frames: FrameSeries, registrations: Registrations) -> None:
        self.frames, self.registrations = frames, registrations
        self.size_px = np.full(len(frames), np.nan)
        self.shaken: set[int] = set()
        self.baseline_px = np.zeros(4)
        self._misses = 0

    def find_knock(self, block: Block, monitored_px: Array) -> Knock | None:
        """Measure the frames of a block up to the first one of a lasting displacement."""
        sizes = np.linalg.norm(monitored_px - self.baseline_px, axis=1)
        if (sizes <= SUSPECT_PX).all():
            self.size_px[block.first : block.stop] = sizes
            self._misses = 0
            return None
        for i, monitored in zip(range(block.first, block.stop), monitored_px, strict=True):
            displacement = monitored - self.baseline_px
            if not np.linalg.norm(displacement) <= SUSPECT_PX:
                displacement, by_image = self._measure(i, block.span)
                self._misses = self._misses + 1 if np.isnan(displacement).any() else 0
                if np.linalg.norm(displacement) > KNOCK_PX:
                    if self._lasts(i, block.span, displacement):
                        return Knock(i, block.span, displacement, by_image)
                    self.shaken.add(i)
                elif np.isfinite(displacement + monitored).all():
                    self.baseline_px = monitored - displacement
            self.size_px[i] = np.linalg.norm(displacement)
        return None

    def span_after(self, knock: Knock) -> RegistrationSpan:
        """Register the plan again on the mean of the frames after a knock; the baseline restarts."""
        old, grid = self.registrations.spans[knock.span].registration, self.registrations.grid
        if knock.by_image:
            registration = shift_registration(old, knock.displacement_px[:2])
        else:
            # The next few frames, up to the next span, that share the displacement.
            stop = min(knock.frame + _MEAN_FRAMES, self.registrations.stop_frame(knock.span) or len(self.frames))
            later = range(knock.frame + 1, stop)
            displaced = [i for i in later if _alike(self._measure(i, knock.span)[0], knock.displacement_px)]
            temperature = self._mean([knock.frame, *displaced])
            name = self.frames.name(knock.frame)
            registration = register_after_knock(temperature, old, knock.displacement_px, grid, frame_name=name)
        self.baseline_px = np.zeros(4)
        column, row, growth, turn = knock.displacement_px.tolist()
        return RegistrationSpan(knock.frame, registration, (column, row, growth, turn))

    def unchecked_stretches(self, left_out: Array) -> list[tuple[int, int]]:
        """First frame and end of stretches of unmeasured frames at whose end no frame nor the mean of several shows the registration."""
        stretches = []
        for index, span in enumerate(self.registrations.spans):
            stop = self.registrations.stop_frame(index) or len(self.frames)
            chosen = [i for i in range(span.first_frame + 1, stop) if not left_out[i]]
            measured = [i for i in chosen if np.isfinite(self.size_px[i])]
            last = measured[-1] if measured else span.first_frame
            after = [i for i in chosen if i > last]
            if not after:
                continue
            mean = self._mean(after[-_MEAN_FRAMES:])
            displacement = fiducial_displacement(mean, span.registration, self.registrations.grid)
            if not np.linalg.norm(displacement) <= KNOCK_PX:
                stretches.append((after[0], stop))
        return stretches

    def _lasts(self, i: int, span: int, displacement_px: Array) -> bool:
        """Whether the first measurable one of the next few frames shares the displacement of a frame, or none can be measured."""
        for following in range(i + 1, min(i + 1 + _FOLLOWING_FRAMES, len(self.frames))):
            other, _ = self._measure(following, span)
            if np.isfinite(other).all():
                return _alike(other, displacement_px)
        return True

    def _measure(self, i: int, span: int) -> tuple[Array, bool]:
        """Displacement of a frame, (4,) px, and whether the image of the table showed it, because the fiducials have no contrast."""
        first, registration = self.registrations.spans[span].first_frame, self.registrations.spans[span].registration
        temperature, grid = self.frames.temperature(i), self.registrations.grid
        displacement = fiducial_displacement(temperature, registration, grid)
        # After frames in which nothing is located, the slow ways are tried at frames 1, 2, 4, 8, ... of the stretch.
        if np.isfinite(displacement).all() or i == first or self._misses & (self._misses - 1):
            return displacement, False
        reference = self.frames.temperature(first)
        displacement = search_displacement(reference, temperature, registration, grid)
        if np.isfinite(displacement).all():
            return displacement, False
        return image_displacement(reference, temperature, registration, grid), True

    def _mean(self, chosen: Sequence[int]) -> Array:
        """Mean temperature of some frames, (row, column) degC."""
        return np.mean([self.frames.temperature(i) for i in chosen], axis=0, dtype=float)


def _alike(displacement_px: Array, other_px: Array) -> bool:
    """Whether a displacement is a knock, and the same as another one."""
    size, other, difference = map(np.linalg.norm, (displacement_px, other_px, displacement_px - other_px))
    return bool(size > KNOCK_PX and difference < max(KNOCK_PX, 0.3 * float(other)))


# Stretches of a recording: what a thread or a worker of a cluster reads and reduces at a time, and how the sums are
# combined.

#: Largest number of frames of a stretch: one to three seconds of work for video of 640 x 480 pixels.
STRETCH_FRAMES = 4096
#: A recording is divided into so many stretches at least, so that several workers end at about the same time, ...
_LEAST_STRETCHES = 16
#: ... but a cycle of no more than this number of frames is not divided.
_UNDIVIDED_FRAMES = 512
#: Largest numbers of blocks and of cycles of a stretch: fields and sums of so many are held in memory at a time.
_MOST_BLOCKS, _MOST_CYCLES = 256, 8


@dataclass(frozen=True)
class Portion:
    """Consecutive blocks of one cycle under one registration, or of no cycle; `whole` where no other portion belongs to the same."""

    blocks: tuple[Block, ...]
    whole: bool

    @property
    def first(self) -> Block:
        """The first block, which tells cycle and registration."""
        return self.blocks[0]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.blocks[-1].stop - self.blocks[0].first


class BlockFrames(NamedTuple):
    """A block with those of its frames that show the table, their times (frames,) datetime64 and their corrections (frames,) K."""

    block: Block
    frames: Sequence[FrameReference]
    times: Array
    correction_K: Array


@dataclass(frozen=True)
class PortionResult:
    """What every block of a portion shows, and its share of the cycle: pixels, or cells of a whole one; None for frames of no cycle."""

    blocks: tuple[BlockResult, ...]
    part: CyclePart | None


def cut_stretches(blocks: Sequence[Block], *, total: int, begun: tuple[int, int] | None = None) -> list[list[Portion]]:
    """Divide blocks into stretches of about equal work, each within one registration."""
    wanted = min(max(total // _LEAST_STRETCHES, 1), STRETCH_FRAMES)
    longest = min(max(wanted, _UNDIVIDED_FRAMES), STRETCH_FRAMES)
    stretches: list[list[Portion]] = []
    frames = held = 0
    for portion in _cut_portions(blocks, longest, begun):
        number = len(portion.blocks)
        if (
            not stretches
            or frames >= wanted
            or frames + portion.frames > longest
            or held + number > _MOST_BLOCKS
            or len(stretches[-1]) == _MOST_CYCLES
            or stretches[-1][0].first.span != portion.first.span
        ):
            stretches.append([])
            frames = held = 0
        stretches[-1].append(portion)
        frames, held = frames + portion.frames, held + number
    return stretches


def _cut_portions(blocks: Sequence[Block], longest: int, begun: tuple[int, int] | None) -> Iterator[Portion]:
    """Yield the blocks of every cycle and registration, divided where they are more than `longest` frames or the most blocks."""
    for key, of_cycle in groupby(blocks, lambda block: (block.cycle, block.span)):
        pieces: list[list[Block]] = []
        for block in of_cycle:
            if not pieces or block.stop - pieces[-1][0].first > longest or len(pieces[-1]) == _MOST_BLOCKS:
                pieces.append([])
            pieces[-1].append(block)
        for piece in pieces:
            yield Portion(tuple(piece), whole=len(pieces) == 1 and key != begun)


def gather_frames(frames: FrameSeries, blocks: Iterable[Block]) -> list[BlockFrames]:
    """Return the frames of blocks for `reduce_stretch`."""
    return [choose_frames(frames, block, np.arange(block.first, block.stop)) for block in blocks]


def choose_frames(frames: FrameSeries, block: Block, chosen: Array) -> BlockFrames:
    """Return some frames of a block, (n,) indices, for `reduce_portion`."""
    references = [frames.references[i] for i in chosen]
    return BlockFrames(block, references, frames.times[chosen], frames.correction_K[chosen])


def reduce_stretch(
    portions: Sequence[tuple[Sequence[BlockFrames], bool]], sensor: RegisteredSensor
) -> list[PortionResult]:
    """Read and reduce a stretch: the task of a thread or of a worker."""
    return [reduce_portion(members, sensor, whole=whole) for members, whole in portions]


def reduce_portion(members: Sequence[BlockFrames], sensor: RegisteredSensor, *, whole: bool) -> PortionResult:
    """Read and reduce the blocks of a portion, and combine them one after the other."""
    first = members[0].block
    blocks: list[BlockResult] = []
    part = CyclePart(first.cycle, first.span) if first.cycle != NO_CYCLE else None
    for member in members:
        reduced = reduce_block(member.frames, member.block.parameters, sensor)
        temperature, correction_K = reduced.temperature, float(member.correction_K.mean())
        if part is not None and temperature is not None:
            part.add(replace(temperature, mean=temperature.mean + correction_K), member.times)
        # The field is kept as the products hold it.
        cells = (reduced.cells + correction_K).astype(np.float32)
        blocks.append(replace(reduced, cells=cells, temperature=None))
    if part is not None and whole:
        part.finish(sensor.weights)
    return PortionResult(tuple(blocks), part)


#: Consecutive frames of one cycle within this time share one field of the frame stack, s.
BLOCK_S = 10.0
#: The open cycle is stored whenever it has grown by this number of frames: the most that an interrupted run has to repeat.
STORED_FRAMES = 4096


def reduce_frames(
    references: Sequence[FrameReference],
    registration: Registration | Sequence[RegistrationSpan],
    grid: PlanGrid,
    cycle_bounds: ArrayLike,
    *,
    override: Override = lambda frame: frame.parameters,
    correction_K: ArrayLike | None = None,
    detector: Detector | None = None,
    block_s: float = BLOCK_S,
    scheduler: str | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Reduce frames of a still table to one temperature field per cycle on the table plan.

    Counts are averaged, not temperatures, which is exact to the second order of the calibration curve; where the counts of a pixel
    vary too much for that, its frames are calibrated one by one. The fiducials of every frame are compared with the registration;
    where they have moved and remain so, the plan is registered again from that frame on.

    Parameters
    ----------
    references : sequence of FrameReference
        Frames sorted by time, from `thermography.io.flir.index_frames`.
    registration : Registration, or sequence of RegistrationSpan
        For all frames, or spans of frames in order, the first starting at frame 0.
    grid : PlanGrid
        The plan.
    cycle_bounds : (cycles, 2) or (cycles + 1,) array of datetime64
        Start and end of every cycle, or the edges between cycles, on the frames' clock; the end is excluded.
    override : callable
        From a frame reference to the camera parameters to calibrate the frame with; by default the frame's own.
    correction_K : (frames,) array, K, or None
        Added to the temperature of every frame, to correct artefacts of the camera (NUC/FFC events, drift).
    detector : Detector or None
        Bad pixels, which have no weight, and clipped counts, of which a cell is empty, as `thermography.fields.survey.survey_frames`
        finds them.
    block_s : float, s
        Frames of one cycle within this time share one field of `frame_temperature`; 0 gives every frame its own.
    scheduler : str or None
        Address of a dask scheduler whose workers see the same files; None for threads on the cores of this machine.
    checkpoint : str, Path or None
        Folder for finished cycles. A run that finds it resumes there, also within a long cycle.
    progress : callable or None
        Called with the number of frames done since the last call.

    Returns
    -------
    xr.Dataset
        Variables of `thermography.common.FIELDS` with dimensions (cycle, y, x) in degC and K, coordinates in mm, but for the total
        uncertainties, which `thermography.fields.total_uncertainty.evaluate_uncertainty` adds; further `temperature_rate`,
        `quality_flag`, `position_u`, and as JSON texts the attributes `frames_outside_cycles` (their fields are in the stack),
        `knocks` (frame, shift in px, zoom, turn, whether it crept), `frames_shaken` (displaced alone, left out), `frames_obstructed`
        (something before the table, left out), `frames_unchecked` (too little contrast to locate the fiducials) and
        `unchecked_stretches` (of such frames, after which no frame shows that the registration held).

    Raises
    ------
    ReductionError
        There is no frame, frames differ in size or are out of order, cycles overlap, or no frame lies within any cycle.
    RegistrationError
        The plan is not located any more after a knock.
    CheckpointError
        The checkpoint belongs to another reduction.

    Notes
    -----
    See ``docs/method/fields.md``; the average of counts is derived in `thermography.radiometry.averaging`.
    """
    spans = [RegistrationSpan(0, registration)] if isinstance(registration, Registration) else list(registration)
    starts = [span.first_frame for span in spans]
    if not starts or starts[0] != 0 or (np.diff(starts) <= 0).any():
        raise ReductionError(f"registrations start at frames {starts}; they must start at 0 and rise")
    frames = make_frame_series(
        references,
        cycle_bounds,
        shape=spans[0].registration.shape,
        override=override,
        correction_K=correction_K,
        detector=detector,
    )
    if (frames.cycles == NO_CYCLE).all():
        raise frames.outside_cycles("no frame")
    store = None
    if checkpoint is not None:
        store = Checkpoint(checkpoint, describe_reduction(frames, grid, spans, block_s=block_s))
    reduction = StillReduction(frames, grid, spans, store)
    done = reduction.resume()
    if progress is not None and done:
        progress(done)
    with open_pool(scheduler) as pool:
        while done < len(frames):
            done = _reduce_until_knock(reduction, pool, done, block_s=block_s, progress=progress)
    return reduction.dataset()


def _reduce_until_knock(
    reduction: StillReduction, pool: Pool, first: int, *, block_s: float, progress: Callable[[int], None] | None
) -> int:
    """Reduce the frames from `first` on, stretch by stretch, up to the block in which a knock is found; the first frame not reduced."""
    frames, registrations = reduction.frames, reduction.registrations
    blocks = cut_blocks(frames, registrations.spans, block_s=block_s, first=first)
    sensors = [pool.share(sensor) for sensor in registrations.sensors]
    tasks = (
        (stretch, (reduce_stretch, [(gather_frames(frames, p.blocks), p.whole) for p in stretch], sensors[span]))
        for stretch in cut_stretches(blocks, total=len(frames), begun=reduction.begun)
        for span in [stretch[0].first.span]
    )
    with closing(in_order(pool, tasks)) as results:
        for stretch, reduced in results:
            for portion, result in zip(stretch, reduced, strict=True):
                knocked = reduction.gather(portion, result)
                stop = portion.blocks[-1].stop if knocked is None else knocked.first
                if progress is not None and stop > portion.first.first:
                    progress(stop - portion.first.first)
                if knocked is not None:
                    return stop
    return len(frames)


class StillReduction:
    """State of a reduction under way: what has been gathered in the order of time, and how many blocks and frames of it the checkpoint
    holds; `open` is the last cycle as long as it has pixels.
    """

    def __init__(
        self, frames: FrameSeries, grid: PlanGrid, spans: Sequence[RegistrationSpan], checkpoint: Checkpoint | None
    ) -> None:
        self.frames, self.grid, self.checkpoint = frames, grid, checkpoint
        self.registrations = Registrations(spans, grid, frames.detector)
        self.displacement = Displacements(frames, self.registrations)
        self.obstructions = Obstructions(frames, self.registrations)
        self.folder = None if checkpoint is None else checkpoint.folder
        self.blocks: list[Block] = []
        self.fields: Spool[Array] = Spool(self.folder)
        self.finished: Spool[CyclePart] = Spool(self.folder)
        self.open: CyclePart | None = None
        self.stored_blocks = self.stored_frames = self.finished_frames = 0

    @property
    def begun(self) -> tuple[int, int] | None:
        """Cycle and registration of the open cycle, if there is one."""
        return None if self.open is None else (self.open.cycle, self.open.span)

    def resume(self) -> int:
        """Load what an earlier run has stored; the first frame that is not done."""
        done = 0
        if self.checkpoint is None:
            return done
        for knock in self.checkpoint.load("knock_*"):
            self.register_again(Knock(**knock))
        for names in ("frames_*", _OPEN_CYCLE):
            self.stored_blocks, self.finished_frames = len(self.blocks), done
            for cycle in self.checkpoint.load(names):
                if cycle["first_frame"] == done:
                    done = self._restore(cycle)
        self.stored_frames = done
        return done

    def _restore(self, stored: Mapping[str, Any]) -> int:
        """Take over a cycle that `_store` has stored; the first frame after it."""
        for (first, stop, number, span), field in zip(stored["blocks"].tolist(), stored["stack"], strict=True):
            self.blocks.append(Block(first, stop, number, span, self.frames.override(self.frames.references[first])))
            self.fields.append(field)
        part = CyclePart(**{each.name: stored[each.name] for each in fields(CyclePart) if each.name in stored})
        if "pixel_mean" in stored:
            part.pixels = MeanTemperature(part.frames, *(stored[f"pixel_{name}"] for name in _PIXELS))
        self._add_part(part)
        stop = int(stored["stop_frame"])
        self.displacement.size_px[stored["first_frame"] : stop] = stored["shift_px"]
        self.displacement.shaken.update(stored["shaken"].tolist())
        self.obstructions.found.update(stored["obstructed"].tolist())
        self.displacement.baseline_px = stored["baseline_px"]
        return stop

    def register_again(self, knock: Knock) -> None:
        """Register the plan again from the frame of a knock on."""
        span = self.displacement.span_after(knock)
        if self.checkpoint is not None:
            self.checkpoint.save(f"knock_{knock.frame:08d}_{knock.span:04d}", **vars(knock))
        self.registrations.insert(knock.span + 1, span)

    @property
    def left_out(self) -> set[int]:
        """Frames so far that are shaken or obstructed."""
        return self.displacement.shaken | self.obstructions.found

    def kept(self, block: Block) -> Array:
        """Indices of the frames of a block that show the table where it is registered."""
        left_out = self.left_out
        return np.array([i for i in range(block.first, block.stop) if i not in left_out], int)

    def gather(self, portion: Portion, result: PortionResult) -> Block | None:
        """Add a portion to the stack and to its cycle, up to the block of a knock, which is returned; the plan is then registered again."""
        kept: list[tuple[Block, Array]] = []
        complete, knocked = True, None
        for block, reduced in zip(portion.blocks, result.blocks, strict=True):
            knock = self.displacement.find_knock(block, reduced.displacement_px)
            if knock is not None:
                knocked = block
                break
            self.obstructions.examine(block, reduced)
            chosen = self.kept(block)
            complete = complete and len(chosen) == block.stop - block.first
            if len(chosen):
                kept.append((block, chosen))
        if kept:
            if knocked is not None or not complete:
                members = [choose_frames(self.frames, block, chosen) for block, chosen in kept]
                sensor = self.registrations.sensors[portion.first.span]
                result = reduce_portion(members, sensor, whole=portion.whole and knocked is None)
            self._add([block for block, _ in kept], result)
        if knock is not None:
            self.register_again(knock)
        return knocked

    def _add(self, blocks: Sequence[Block], result: PortionResult) -> None:
        """Add blocks and their share of a cycle."""
        first = blocks[0]
        if self.begun not in (None, (first.cycle, first.span)):
            self.close()
        self.blocks.extend(blocks)
        for reduced in result.blocks:
            self.fields.append(reduced.cells)
        if result.part is None:
            return
        self._add_part(result.part)
        if result.part.pixels is None:
            self._store_finished(result.part)
        elif self.open is not None and blocks[-1].stop - self.stored_frames >= STORED_FRAMES:
            self._store(self.open)

    def _add_part(self, part: CyclePart) -> None:
        """Add a share to the open cycle, or begin its cycle; one that is finished already has no other share."""
        if part.pixels is None:
            self.finished.append(part)
        elif self.open is None:
            self.open = part
        else:
            self.open.join(part)

    def close(self) -> None:
        """Finish the open cycle, if there is one, and store it."""
        part, self.open = self.open, None
        if part is not None:
            part.finish(self.registrations.sensors[part.span].weights)
            self.finished.append(part)
            self._store_finished(part)

    def _store_finished(self, part: CyclePart) -> None:
        """Store the last cycle, which is finished."""
        self._store(part)
        self.stored_blocks, self.finished_frames = len(self.blocks), self.stored_frames

    def _store(self, part: CyclePart) -> None:
        """Store the last cycle, finished or open, with all blocks since the previous one."""
        if self.checkpoint is None:
            return
        blocks = self.blocks[self.stored_blocks :]
        first, stop = self.finished_frames, blocks[-1].stop
        stored = {name: value for name, value in vars(part).items() if name != "pixels"}
        if part.pixels is not None:
            stored |= {f"pixel_{name}": getattr(part.pixels, name) for name in _PIXELS}
        self.checkpoint.save(
            _OPEN_CYCLE if part.pixels is not None else f"frames_{first:08d}",
            **stored,
            first_frame=first,
            stop_frame=stop,
            blocks=np.array([(b.first, b.stop, b.cycle, b.span) for b in blocks]),
            stack=np.stack(self.fields[self.stored_blocks :]),
            shift_px=self.displacement.size_px[first:stop],
            shaken=np.array(sorted(i for i in self.displacement.shaken if first <= i < stop), int),
            obstructed=np.array(sorted(i for i in self.obstructions.found if first <= i < stop), int),
            baseline_px=self.displacement.baseline_px,
        )
        self.stored_frames = stop

    def dataset(self) -> xr.Dataset:
        """Finish the open cycle and assemble the fields, the frame stack and the lists of frames with remarks."""
        self.close()
        frames, displacement = self.frames, self.displacement
        if not self.finished:
            raise ReductionError("no frame of a cycle shows the table where it is registered; clear the view of it")
        kept = [self.kept(block) for block in self.blocks]
        fields = assemble_fields(
            self.finished,
            len(frames.bounds),
            self.grid,
            self.registrations.covariances,
            [sensor.weights.coverage for sensor in self.registrations.sensors],
            frames=self._frame_variables(kept),
            frame_coordinates={"time": np.array([frames.mean_time(chosen) for chosen in kept])},
            folder=self.folder,
        )
        left_out = np.isin(np.arange(len(frames)), [*self.left_out])
        remarks = {
            "frames_outside_cycles": frames.names(frames.cycles == NO_CYCLE),
            "knocks": [self._knock(span, before) for before, span in pairwise(self.registrations.spans)],
            "frames_shaken": [frames.name(i) for i in sorted(displacement.shaken)],
            "frames_obstructed": [frames.name(i) for i in sorted(self.obstructions.found)],
            "frames_unchecked": frames.names(np.isnan(displacement.size_px) & ~left_out),
            "unchecked_stretches": [
                {"first": frames.name(first), "last": frames.name(stop - 1), "frames": stop - first}
                for first, stop in displacement.unchecked_stretches(left_out)
            ],
        }
        return fields.assign_attrs({name: json.dumps(value) for name, value in remarks.items()})

    def _frame_variables(self, kept: Sequence[Array]) -> dict[str, Any]:
        """Variables along ``time``, from the frames of each block that are used."""
        shape = (len(self.fields), *self.grid.shape)
        stack = fill_array(shape, np.float32, lambda some: self.fields[some], self.folder)
        shifts = np.full(len(kept), np.nan, np.float32)
        for k, chosen in enumerate(kept):
            sizes = self.displacement.size_px[chosen]
            if np.isfinite(sizes).any():
                shifts[k] = np.nanmax(sizes)
        return {
            "frame_temperature": (("time", "y", "x"), stack),
            "frame_cycle": ("time", np.array([block.cycle + 1 for block in self.blocks], np.int32)),
            "frame_count": ("time", np.array([len(chosen) for chosen in kept], np.int32)),
            "frame_shift": ("time", shifts),
        }

    def _knock(self, span: RegistrationSpan, before: RegistrationSpan) -> dict[str, Any]:
        """What is reported of the knock before a registration span."""
        zoom, turn_deg = zoom_and_turn(span.displacement_px, before.registration)
        # A knock comes from one frame to the next; what creeps was displaced already.
        last_px = self.displacement.size_px[
            max(before.first_frame, span.first_frame - _CREPT_FRAMES) : span.first_frame
        ]
        crept = np.nan_to_num(last_px).max(initial=0.0) > float(np.linalg.norm(span.displacement_px)) / 2
        return {
            "frame": self.frames.name(span.first_frame),
            "index": span.first_frame,
            "shift_px": list(span.displacement_px[:2]),
            "zoom": zoom,
            "turn_deg": turn_deg,
            "crept": bool(crept),
        }
