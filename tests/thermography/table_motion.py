"""A positioning test as a camera sees it: the table travels, stands, is read and goes on."""

import numpy as np

T0 = np.datetime64("2026-03-09T06:30:00", "ns")
FEED_MM_S, DWELL_S, PAUSE_S = 5.0, 2.0, 60.0
TARGETS = np.arange(16) * 20.0


def positioning_test(cycles):
    """Readings of a test there and back, the table going on right after each; and the corners of the true motion."""
    reading_s, reading_mm, way_s, way_mm, now = [], [], [], [], 0.0
    for _ in range(cycles):
        for k, target in enumerate([*TARGETS, *TARGETS[::-1]]):
            before = way_mm[-1] if way_mm else target
            now += abs(target - before) / FEED_MM_S
            way_s.append(now)
            way_mm.append(target)
            now += DWELL_S if k != 16 else 2 * DWELL_S
            way_s.append(now)
            way_mm.append(target)
            reading_s.append(now)
            reading_mm.append(target)
        now += PAUSE_S
    return np.array(reading_s), np.array(reading_mm), np.array(way_s), np.array(way_mm)


def campaign(rng, *, cycles=6, offset_s=37.0, rate=0.0, interval_s=9.7, u_mm=0.1, margin_s=0.0):
    """Frame times, seen positions and their u, reading times and targets, as `estimate_clock_offset` takes them."""
    reading_s, reading_mm, way_s, way_mm = positioning_test(cycles)
    frame_s = np.arange(-margin_s, reading_s[-1] + margin_s, interval_s) + rng.uniform(0, 1)
    seen = np.interp(frame_s, way_s, way_mm) - 40.0 + rng.normal(0, u_mm, frame_s.size)
    camera_s = frame_s + offset_s + rate * (frame_s - frame_s.mean())
    stamp = [T0 + np.round(1e3 * s).astype(np.int64) * np.timedelta64(1, "ms") for s in (camera_s, reading_s)]
    return stamp[0], seen, np.full(seen.size, u_mm), stamp[1], reading_mm
