"""Map a device's clock to this computer's: without drift or jitter, and never backwards."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

BUCKET_NS = 500_000_000
"""Length of a bucket; the fit uses the quickest frame of each."""
BUCKETS = 60
"""Buckets of the fit: 30 s, over which a crystal's rate hardly changes."""
MAX_SKEW = 1e-3
"""Limit of the fitted rate; crystals are within 1e-4."""
MAX_DELAY_SPREAD_NS = 50_000_000
"""The least delays of two buckets differ by less; a line that rises or falls by more is a wrong rate."""
_FIT_BUCKETS = 8  # with fewer the fitted rate is noise, so the device's is taken as exact
_JUDGE_BUCKETS = 4  # with fewer one late bucket is an edge of the hull
_SETTLE_NS = 1_000_000_000
_MAX_SLEW = 0.1
# If the clocks part by more between two frames, or a frame arrives earlier than its time by more, the device's clock
# was set.
_JUMP_NS = 1_000_000_000
# A clock that is set this often, at these intervals, over this time keeps no time. A computer that stalls is slower.
_RESTARTS, _RESTART_GAP_NS, _RESTARTING_NS = 6, 2_500_000_000, 2_000_000_000


class _Point(NamedTuple):
    x_ns: int
    """Device time."""
    y_ns: int
    """Arrival less device time, less the same of the first frame: how far the clocks have parted since, plus the
    difference of the two frames' delays."""


class DeviceClock:
    """Convert the device's time of a chirp to CLOCK_MONOTONIC.

    A frame arrives late by a delay that varies but is never negative, so the offset of the clocks is the lower envelope
    of (arrival less device time). The envelope is a straight line while the rates are constant. Of all lines under the
    points, the closest is the edge of their lower convex hull above the mean of x (S. Moon, P. Skelly, D. Towsley,
    "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999). The output follows that line
    without steps.

    A clock whose rate no crystal has (another unit, or no clock at all) is given up: times are then those of arrival,
    and `fault` says why, until the rate is right for 30 s.

    `complete_ns` is the time from the start of a chirp to its last sample, the least delay of a frame; `last_t_ns` that
    of the last frame of an earlier connection: later frames are later.
    """

    def __init__(self, complete_ns: int, last_t_ns: int = -1) -> None:
        self.delay_ns = 0
        """How much later than the quickest frames the last frame arrived."""
        self.fault: str | None = None
        """Why times are those of arrival, for a person; None while the device's clock is used."""
        self.ppm = 0.0
        """How much faster than this computer's the device's clock runs, parts per million; 0 before 4 s tell."""
        self._complete_ns = complete_ns
        self._epoch_ns: int | None = None
        self._restarts, self._restarted_ns = 0, -_RESTART_GAP_NS - 1
        self._series = _Point(0, 0)  # device time and arrival at the first of the restarts
        self._last_ns = self._last_x_ns = self._first_ns = 0
        self._intercept_ns = self._offset_ns = self._skew = 0.0
        self._last_t_ns = last_t_ns
        self._last_received_ns = 0

    def map(self, timestamp_us: int, received_ns: int) -> int:
        """Return when a frame's chirp began, CLOCK_MONOTONIC in ns; it increases from call to call.

        `timestamp_us` is the device's clock at the start of the chirp, `received_ns` CLOCK_MONOTONIC when the frame was
        complete on this computer.
        """
        device_ns = timestamp_us * 1000
        step_ns = device_ns - self._last_ns
        if self._epoch_ns is None:
            self._begin(device_ns, received_ns)
        elif step_ns <= 0 or abs(received_ns - self._last_received_ns - step_ns) > _JUMP_NS:
            self._restart(device_ns, received_ns)
        t_ns = self._fitted_ns(device_ns, received_ns)
        if t_ns > received_ns - self._complete_ns + _JUMP_NS:
            self._restart(device_ns, received_ns)
            t_ns = self._fitted_ns(device_ns, received_ns)
        self._last_ns, self._last_received_ns = device_ns, received_ns
        arrived_ns = received_ns - self._complete_ns
        # Until a slow clock can be told from a late frame, a subscriber must not take new touches for old.
        young = len(self._minima) < _JUDGE_BUCKETS and arrived_ns - t_ns > MAX_DELAY_SPREAD_NS
        if self.fault or young:
            t_ns = arrived_ns
        self.delay_ns = arrived_ns - t_ns
        self._last_t_ns = max(t_ns, self._last_t_ns + 1)
        return self._last_t_ns

    def _fitted_ns(self, device_ns: int, received_ns: int) -> int:
        """Add a frame to the fit, and return its time by it."""
        assert self._epoch_ns is not None
        x_ns, first_ns, skew = device_ns - self._epoch_ns, self._first_ns, self._skew
        arrived_ns = received_ns - self._complete_ns - first_ns
        y_ns, step_ns = arrived_ns - x_ns, x_ns - self._last_x_ns
        self._last_x_ns = x_ns
        # Most frames are neither the first of a bucket nor quicker than all before.
        if arrived_ns >= self._bucket_end_ns or y_ns < self._quickest_ns or y_ns < self._intercept_ns + skew * x_ns:
            self._add(_Point(x_ns, y_ns), arrived_ns // BUCKET_NS)
            skew = self._skew
        # Move the offset towards the line, slowly enough that time neither jumps nor runs backwards.
        offset_ns = self._offset_ns + skew * step_ns
        error_ns = self._intercept_ns + skew * x_ns - offset_ns
        if error_ns:
            limit_ns = _MAX_SLEW * step_ns
            offset_ns += min(max(error_ns * min(1.0, step_ns / _SETTLE_NS), -limit_ns), limit_ns)
        self._offset_ns = offset_ns
        return first_ns + x_ns + round(offset_ns)

    def _restart(self, device_ns: int, received_ns: int) -> None:
        """Begin again, since the device's clock was set; give up a clock that is set again and again."""
        if received_ns - self._restarted_ns > _RESTART_GAP_NS:
            self._restarts, self._series = 0, _Point(device_ns, received_ns)
        self._restarts += 1
        self._restarted_ns = received_ns
        elapsed_ns = received_ns - self._series.y_ns
        if self._restarts >= _RESTARTS and elapsed_ns >= _RESTARTING_NS:
            self._give_up((device_ns - self._series.x_ns) / elapsed_ns)
        self._begin(device_ns, received_ns)

    def _give_up(self, rate: float) -> None:
        if self.fault is None:
            runs = f"runs at {rate:.4g} times the right rate" if rate > 0 else "stands still, or goes back"
            self.fault = f"the device's clock {runs}: times are those of arrival"

    def _begin(self, device_ns: int, received_ns: int) -> None:
        self._epoch_ns = device_ns
        self._minima: deque[_Point] = deque(maxlen=BUCKETS)
        self._bucket = 0
        self._bucket_end_ns = self._quickest_ns = 0
        self._skew = self.ppm = 0.0
        # An integer, exact after any uptime; floats hold only how far the clocks have parted since.
        self._first_ns = received_ns - self._complete_ns
        # Height of the line at x = 0; and what is added to device time, which follows the line.
        self._intercept_ns = self._offset_ns = 0.0
        self._last_x_ns = 0

    def _add(self, point: _Point, bucket: int) -> None:
        if bucket != self._bucket or not self._minima:
            if self._minima:
                self._fit()
            self._bucket = bucket
            self._minima.append(point)
        elif point.y_ns < self._minima[-1].y_ns:
            self._minima[-1] = point
        self._bucket_end_ns, self._quickest_ns = (self._bucket + 1) * BUCKET_NS, self._minima[-1].y_ns
        # A frame below the line shows that the line was too high.
        self._intercept_ns = min(self._intercept_ns, point.y_ns - self._skew * point.x_ns)

    def _fit(self) -> None:
        """Fit the line under the points."""
        points = list(self._minima)
        self._skew = 0.0
        if len(points) >= _JUDGE_BUCKETS:
            low, high = _edge_above_mean(points)
            self._judge(high.x_ns - low.x_ns, high.y_ns - low.y_ns)
            if len(points) >= _FIT_BUCKETS:
                skew = (high.y_ns - low.y_ns) / (high.x_ns - low.x_ns)
                self.ppm = -1e6 * skew / (1 + skew)
                self._skew = min(max(skew, -MAX_SKEW), MAX_SKEW)
        self._intercept_ns = min(y - self._skew * x for x, y in points)

    def _judge(self, device_ns: int, parted_ns: int) -> None:
        """Give the clock up if it is no crystal's by how far it parts in a time; trust it again if it is for 30 s."""
        if abs(parted_ns) > MAX_SKEW * device_ns + MAX_DELAY_SPREAD_NS:
            self._give_up(device_ns / (device_ns + parted_ns))
        elif len(self._minima) == BUCKETS:
            self.fault = None


def _edge_above_mean(points: list[_Point]) -> tuple[_Point, _Point]:
    """Return the edge of the lower convex hull that the mean of x lies in; x increases (Andrew's monotone chain)."""
    hull: list[_Point] = []
    for p in points:
        while len(hull) >= 2:
            (ax, ay), (bx, by) = hull[-2:]
            if (bx - ax) * (p.y_ns - ay) > (by - ay) * (p.x_ns - ax):
                break
            hull.pop()
        hull.append(p)
    mean_ns = sum(p.x_ns for p in points) / len(points)
    at = next(i for i, p in enumerate(hull) if p.x_ns >= mean_ns)
    return hull[max(at - 1, 0)], hull[max(at, 1)]
