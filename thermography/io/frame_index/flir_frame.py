"""A frame in a FLIR file, without its pixels."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from thermography.io.fff_record import FffSource, damaged_records, read_counts, read_directory
from thermography.io.frame import Frame, FrameHeader, FrameReference, PlainSamples, SampleLocation, Segments


@dataclass(frozen=True, kw_only=True)
class FlirFrameReference(FrameReference):
    """A frame in a FLIR file; further attributes are those of `FrameReference`.

    Attributes
    ----------
    segments : tuple of (offset, length)
        Segments of the FFF record in the file, bytes.
    camera_info_place : (offset, length)
        Place of the camera information in the record, bytes.
    samples : SampleLocation
        Place and packing of the pixels in the record.
    """

    segments: Segments
    camera_info_place: tuple[int, int]
    samples: SampleLocation

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.samples.shape

    @property
    def plain_samples(self) -> PlainSamples | None:
        """Place of the pixels; None where they are packed, or parted into the segments of a JPEG."""
        if self.samples.encoding != "raw" or len(self.segments) != 1:
            return None
        return PlainSamples(self.segments[0][0] + self.samples.offset, self.samples.little_endian)

    def read(self) -> Frame:
        """Read the frame with its pixels and camera information; raise FlirFormatError where they are damaged."""
        with self.path.open("rb", buffering=0) as file:
            return self.read_from(file)

    def read_from(self, file: BinaryIO) -> Frame:
        """As `read`, from the open file."""
        source = FffSource(file, self.path, self.segments)
        info = source.take(*self.camera_info_place, "camera information")
        counts = read_counts(source, self.samples)
        header = {each.name: getattr(self, each.name) for each in fields(FrameHeader)}
        return Frame(**header, counts=counts, source=str(self.path), index=self.index, camera_info=info)

    def damaged_records(self) -> list[int]:
        """Return the types of all records that differ from their checksums; reading compares that of the pixels only."""
        with self.path.open("rb", buffering=0) as file:
            source = FffSource(file, self.path, self.segments)
            return damaged_records(source, read_directory(source))

    def read_counts(self) -> NDArray[np.uint16]:
        """Read the pixels only, (row, column) uint16; raise FlirFormatError where they are damaged."""
        with self.path.open("rb", buffering=0) as file:
            return read_counts(FffSource(file, self.path, self.segments), self.samples)
