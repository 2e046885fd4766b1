"""Commands that run beside Blender: their lines are read in a thread, and taken where Blender has time for them."""

import os
import queue
import subprocess
import threading
from collections.abc import Sequence


class Background:
    """Commands, one after the other; the next one begins when the one before has ended with exit code 0."""

    def __init__(self, commands: Sequence[Sequence[str]]) -> None:
        """Start them. What cannot be started counts as ended with code 127, with the reason as its line."""
        self._commands = [list(command) for command in commands]
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._process: subprocess.Popen[str] | None = None
        self._cancelled = False
        self._lock = threading.Lock()
        self._code: int | None = None
        self._thread = threading.Thread(target=self._work, name="jaxdn", daemon=True)
        self._thread.start()

    @property
    def cancelled(self) -> bool:
        """Whether :meth:`cancel` was called before the end."""
        return self._cancelled

    def poll(self) -> tuple[list[str], int | None]:
        """The lines since the last call, and the exit code once everything has ended."""
        ended = not self._thread.is_alive()  # asked first: then no line comes later
        lines = []
        while not self._lines.empty():
            lines.append(self._lines.get())
        return lines, self._code if ended else None

    def cancel(self) -> None:
        """End the command that runs; the files that it has finished stay."""
        with self._lock:
            if self._thread.is_alive():
                self._cancelled = True
                if self._process is not None:
                    self._process.terminate()

    def wait(self, seconds: float | None = None) -> None:
        """Wait for the end, or for a time."""
        self._thread.join(seconds)

    def _work(self) -> None:
        code = 0
        for command in self._commands:
            try:
                process = self._begin(command)
            except OSError as error:
                self._lines.put(f"{command[0]}: {error.strerror or error}")
                code = 127
            else:
                if process is None:
                    break
                assert process.stdout is not None
                with process.stdout:
                    for line in process.stdout:
                        self._lines.put(line.rstrip())
                code = process.wait()
            if code:
                break
        self._code = code

    def _begin(self, command: list[str]) -> subprocess.Popen[str] | None:
        """The process; None after :meth:`cancel`."""
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8", "COLUMNS": "500"}
        with self._lock:
            if self._cancelled:
                return None
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                encoding="utf-8",
                errors="replace",
                env=environment,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
            return self._process
