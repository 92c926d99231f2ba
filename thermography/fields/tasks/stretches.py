"""Stretches of a recording: what a thread or a worker of a cluster reads and reduces at a time, and how the sums are combined.

Frames are summed to blocks, blocks to portions of a cycle, portions to the cycle. A worker reads its stretch of the files itself and
returns what the blocks show and one set of sums per portion; a cycle that lies within a stretch is averaged over the plan there. How
frames are divided depends on the recording alone, not on who reads it, so that threads and clusters give the same result bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from thermography._typing import Array
from thermography.fields.blocks import Block, BlockView, RegisteredSensor, reduce_block
from thermography.fields.checkpoint import ParameterGroup
from thermography.fields.cycle_fields import CyclePart
from thermography.fields.inputs import NO_CYCLE, FrameSeries
from thermography.fields.tasks.frame_run import FrameRun

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
    """Consecutive blocks of one cycle under one registration, or of no cycle.

    Attributes
    ----------
    blocks : tuple of Block
    whole : bool
        Whether no other portion belongs to the same cycle and registration.
    """

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


@dataclass(frozen=True)
class BlockFrames:
    """A block with all that is needed to reduce it.

    Attributes
    ----------
    block : Block
    frames : FrameRun
        Its frames, or those of them that show the table.
    times : (frames,) ndarray of datetime64
        Of these frames.
    correction_K : float, K
        Mean correction of their temperature.
    """

    block: Block
    frames: FrameRun
    times: Array
    correction_K: float


@dataclass(frozen=True)
class PortionResult:
    """The reduction of a portion.

    Attributes
    ----------
    views : tuple of BlockView
        What every block shows.
    part : CyclePart or None
        Its share of the cycle: pixels, or cells of a whole one; None for frames of no cycle.
    sums : tuple of ParameterGroup
        Sums of counts, if they are kept.
    """

    views: tuple[BlockView, ...]
    part: CyclePart | None
    sums: tuple[ParameterGroup, ...]


def cut_stretches(blocks: Sequence[Block], *, total: int, begun: tuple[int, int] | None = None) -> list[list[Portion]]:
    """Divide blocks into stretches of about equal work, each within one registration.

    Parameters
    ----------
    blocks : sequence of Block
        In the order of time, without gaps.
    total : int
        Frames of the whole recording, by which the length of a stretch is chosen.
    begun : (cycle, span) or None
        Cycle and registration of which frames before the first block are summed already.

    Returns
    -------
    list of list of Portion
        Every stretch as its portions, in order.
    """
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
    """Return the frames of blocks for `reduce_stretch`.

    Parameters
    ----------
    frames : FrameSeries
        All frames.
    blocks : iterable of Block
    """
    return [choose_frames(frames, block, np.arange(block.first, block.stop)) for block in blocks]


def choose_frames(frames: FrameSeries, block: Block, chosen: Array) -> BlockFrames:
    """Return some frames of a block, (n,) indices, for `reduce_portion`.

    Parameters
    ----------
    frames : FrameSeries
        All frames.
    block : Block
    chosen : (n,) ndarray of int
        Indices of the frames that take part.
    """
    references = FrameRun([frames.references[i] for i in chosen])
    return BlockFrames(block, references, frames.times[chosen], float(frames.correction_K[chosen].mean()))


def reduce_stretch(
    portions: Sequence[tuple[Sequence[BlockFrames], bool]], sensor: RegisteredSensor, keep_statistics: bool
) -> list[PortionResult]:
    """Read and reduce a stretch: the task of a thread or of a worker.

    Parameters
    ----------
    portions : sequence of (sequence of BlockFrames, bool)
        The blocks of every portion, and whether it is a whole cycle.
    sensor : RegisteredSensor
        Of their registration.
    keep_statistics : bool
        Whether the results contain the sums of the counts.

    Returns
    -------
    list of PortionResult
    """
    return [reduce_portion(members, sensor, keep_statistics, whole=whole) for members, whole in portions]


def reduce_portion(
    members: Sequence[BlockFrames], sensor: RegisteredSensor, keep_statistics: bool, *, whole: bool
) -> PortionResult:
    """Read and reduce the blocks of a portion, and combine them one after the other.

    Parameters
    ----------
    members : sequence of BlockFrames
        At least one.
    sensor : RegisteredSensor
        Of their registration.
    keep_statistics : bool
        Whether the result contains the sums of the counts.
    whole : bool
        Whether the cycle is averaged over the cells of the plan, because nothing is to be added to it.

    Returns
    -------
    PortionResult
    """
    first = members[0].block
    views: list[BlockView] = []
    sums: list[ParameterGroup] = []
    part = CyclePart(first.cycle, first.span) if first.cycle != NO_CYCLE else None
    for member in members:
        reduced = reduce_block(member.frames, member.block.parameters, sensor, keep_statistics)
        # The field is kept as the products hold it.
        cells = (reduced.cells + member.correction_K).astype(np.float32)
        views.append(replace(reduced.view, cells=cells))
        if part is None:
            continue
        temperature = reduced.temperature
        part.add(replace(temperature, mean=temperature.mean + member.correction_K), member.times)
        if reduced.statistics is not None:
            add_sums(sums, ParameterGroup(member.block.parameters, reduced.statistics, member.correction_K))
    if part is not None and whole:
        part.finish(sensor.weights)
    return PortionResult(tuple(views), part, tuple(sums))


def add_sums(sums: list[ParameterGroup], new: ParameterGroup) -> None:
    """Add sums of counts to those with the same camera parameters and correction, or append them.

    Parameters
    ----------
    sums : list of ParameterGroup
        Changed in place.
    new : ParameterGroup
    """
    for number, group in enumerate(sums):
        if group.parameters == new.parameters and group.correction_K == new.correction_K:
            sums[number] = replace(group, statistics=group.statistics.merge(new.statistics))
            return
    sums.append(new)
