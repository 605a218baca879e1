"""Slow or hung: what a process that takes long is judged by."""

from __future__ import annotations

import psutil

from zsdata.activity import Activity, Doing

STOPPED_SECONDS = 5.0  # a stopped process gets so long to be continued, as after Ctrl-Z and `fg`
IDLE_SECONDS = 7.0  # without a hundredth of a second of CPU time; with the time between two looks, less than 10 s in all
WAITING_STAGES = {"read", "background", "load"}  # may wait for a disk, a server or a download, and have time limits of their own


class Watch:
    """Looks at one worker, again and again, while the training process waits.

    * Stopped (SIGSTOP) for STOPPED_SECONDS: it hangs.
    * Asleep without using any CPU time for IDLE_SECONDS, in a stage that has nothing to wait for: it hangs. The first sample of a process
      is exempt, since models are loaded and downloaded there.
    * At one sample for `timeout_seconds`: it hangs, whatever it does. Only this catches an endless loop, which looks like honest work.

    Time counts as the caller says it passes, so that it stands still while the training process itself is stopped.
    """

    def __init__(self, pid: int, activity: Activity, timeout_seconds: float) -> None:
        self._process = psutil.Process(pid)
        self._activity = activity
        self._timeout_seconds = timeout_seconds
        self._doing: Doing | None = None
        self._cpu_seconds = 0.0
        self._stopped_for = self._idle_for = self._sample_for = 0.0

    def look(self, seconds: float) -> str | None:
        """Why the worker hangs, or None.

        Args:
            seconds: since the last look.
        """
        try:
            status = self._process.status()
            times = self._process.cpu_times()
        except psutil.Error:
            return None  # it has just ended, which shows elsewhere
        doing, cpu_seconds = self._activity.read(), times.user + times.system
        moved = self._doing is None or doing.begun != self._doing.begun
        idle = status in (psutil.STATUS_SLEEPING, psutil.STATUS_IDLE) and cpu_seconds == self._cpu_seconds and doing == self._doing
        may_wait = doing.begun <= 1 or doing.stage in WAITING_STAGES
        self._doing, self._cpu_seconds = doing, cpu_seconds
        self._stopped_for = self._stopped_for + seconds if status == psutil.STATUS_STOPPED else 0.0
        self._idle_for = self._idle_for + seconds if idle and not may_wait else 0.0
        self._sample_for = 0.0 if moved else self._sample_for + seconds
        if self._stopped_for >= STOPPED_SECONDS:
            return f"has been stopped for {self._stopped_for:.0f} s (SIGSTOP)"
        if self._idle_for >= IDLE_SECONDS:
            return f"hangs: it has done nothing for {self._idle_for:.0f} s"
        if self._sample_for >= self._timeout_seconds:
            return f"hangs: it has been busy for {self._sample_for:.0f} s, longer than timeout_seconds allows"
        return None
