"""Select the frames of a source to track: all, or the newest in real time, up to a maximum number or Ctrl-C."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

from epipole.errors import EpipoleError
from epipole.pipelines.slam.config import JobOptions
from epipole.pipelines.slam.sources.folder import FrameSource, QueuedFrame


class Clock:
    """The system's clock."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start."""
        return time.perf_counter()

    def wait(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(seconds)


class FrameStream:
    """The frames to track, with a count of the dropped ones."""

    def __init__(
        self,
        source: FrameSource,
        job: JobOptions,
        is_stopped: Callable[[], bool] = lambda: False,
        clock: Clock | None = None,
        num_dropped: int = 0,
    ) -> None:
        self.source, self.job = source, job
        self.num_dropped = num_dropped
        """Frames whose time passed while another one was tracked."""
        self.is_interrupted = False
        self.problems: list[str] = []
        """Why the source ended early."""
        self._is_stopped = is_stopped
        self._clock = Clock() if clock is None else clock

    def __iter__(self) -> Iterator[QueuedFrame]:
        source = self.source.frames()
        frames = self._wanted(source)
        count, last = 0, self.job.start - self.job.stride
        try:
            for frame in self._in_real_time(frames) if self._waits else frames:
                if self._is_stopped():
                    self.is_interrupted = True
                    return
                if self.source.is_live:
                    self.num_dropped += max(0, frame.number - last - self.job.stride)
                    last = frame.number
                yield frame
                count += 1
                if count == self.job.max_frames:
                    return
        except EpipoleError as error:
            self.problems.append(f"the source ends after {count} frames: {error}")
        finally:
            source.close()

    def _wanted(self, frames: Iterator[QueuedFrame]) -> Iterator[QueuedFrame]:
        return islice(frames, self.job.start, None, self.job.stride)

    @property
    def num_expected(self) -> int:
        """Number of frames to track, if the source announces its frames."""
        wanted = len(range(self.job.start, self.source.num_frames, self.job.stride))
        return min(wanted, self.job.max_frames or wanted)

    def notes(self) -> list[str]:
        """Warnings about the source."""
        return [*self.problems, *self.source.notes()]

    def summary(self) -> dict[str, Any]:
        """Entries for the summary."""
        return {
            "num_dropped": self.num_dropped,
            "interrupted": self.is_interrupted,
            "is_live": self.source.is_live,
            "source": dict(self.source.about),
        }

    @property
    def _waits(self) -> bool:
        return self.job.realtime and not self.source.is_live

    def _in_real_time(self, frames: Iterator[QueuedFrame]) -> Iterator[QueuedFrame]:
        """Yield the newest frame that a live camera would have delivered by now; wait for the next if there is none.

        The clock starts after the first frame, which includes loading and compilation.
        """
        first = next(frames, None)
        if first is None:
            return
        yield first
        start_s = self._clock.now_s() - first.timestamp_s
        waiting = next(frames, None)
        while waiting is not None:
            now_s = self._clock.now_s() - start_s
            following = next(frames, None)
            while following is not None and following.timestamp_s <= now_s:
                self.num_dropped += 1
                waiting, following = following, next(frames, None)
            if waiting.timestamp_s > now_s:
                self._clock.wait(waiting.timestamp_s - now_s)
            yield waiting
            waiting = following
