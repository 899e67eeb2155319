"""Session of a tab: a worker process that runs tasks one at a time, driven over a pipe without blocking the page."""

from __future__ import annotations

import asyncio
import multiprocessing
import signal
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

from estimator.core.errors import ImageError
from skysim.core.errors import InputError
from skysim.experiments.study.execution.workers import environment, one_thread

CAREFUL = {"OPENCV_IO_MAX_IMAGE_PIXELS": str(2**27)}  # most pixels that OpenCV decodes


class WorkerLost(Exception):
    """The worker has died or was closed."""


def serve(pipe: Connection, progress: Any, stop: Any) -> None:
    """Main loop of the worker: receives (task, arguments), sends ("ok", result) or ("bad", message), until the pipe
    closes.

    progress : shared (done, total) of the current task;  stop : shared flag; not 0 asks the task to end
    """
    from skysim.apps.gui.worker.tasks import TASKS, Kept, Stopped

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which closes the pipe

    def watch(done: float, everything: float) -> None:
        progress[:] = done, everything
        if stop.value:
            raise Stopped

    kept = Kept(watch)
    while True:
        try:
            task, arguments = pipe.recv()
        except (EOFError, OSError):
            return
        progress[:] = 0.0, 0.0
        try:
            pipe.send(("ok", TASKS[task](kept, *arguments)))
        except Stopped:
            pipe.send(("bad", "stopped"))
        except (InputError, ImageError) as error:
            pipe.send(("bad", str(error)))
        except MemoryError:
            pipe.send(("bad", "not enough memory for this"))
        except Exception as error:  # a bug in one task must not end the tab
            pipe.send(("bad", f"{type(error).__name__}: {error}"))


class Session:
    """One tab's worker process. Calls are queued and run one at a time."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.progress, self.stop = context.RawArray("d", 2), context.RawValue("b")
        self.process = context.Process(target=serve, args=(theirs, self.progress, self.stop), daemon=True)
        with one_thread(), environment(CAREFUL):
            self.process.start()
        theirs.close()
        self.thread = ThreadPoolExecutor(1, "lab")

    async def ask(self, task: str, *arguments: Any) -> Any:
        """Run a task and return its result. Raises InputError for a user error, Gone if the worker has ended."""
        return await asyncio.get_running_loop().run_in_executor(self.thread, self.call, task, arguments)

    def call(self, task: str, arguments: tuple[Any, ...]) -> Any:
        """Send a task and wait for its result; runs in the session's thread."""
        self.stop.value = 0
        try:
            self.pipe.send((task, arguments))
            verdict, answer = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise WorkerLost("this tab's worker has stopped: reload the page") from error
        if verdict == "bad":
            raise InputError(answer)
        return answer

    def halt(self) -> None:
        """Ask the current task to end; only tasks that report progress do."""
        self.stop.value = 1

    @property
    def share(self) -> float:
        """Completed fraction of the current task."""
        done, everything = self.progress[:]
        return done / everything if everything else 0.0

    def close(self) -> None:
        """End the worker process."""
        self.halt()
        self.process.terminate()
        self.process.join(2.0)
        self.pipe.close()
        self.thread.shutdown(wait=False, cancel_futures=True)


class SpareWorker:
    """Keeps a worker ready for the next tab, because its imports and compilation take seconds.

    scene : file from which it solves a frame to warm up
    """

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.next: Session | None = None

    def begin(self) -> None:
        """Start a spare worker if there is none."""
        if self.next is None:
            self.next = Session()
            self.next.thread.submit(self.next.call, "warm", (self.scene,))

    def take(self) -> Session:
        """Return the spare worker, or else a new one."""
        found, self.next = self.next, None
        return found if found and found.process.is_alive() else Session()

    def end(self) -> None:
        """Close the spare worker as the server ends."""
        if self.next:
            self.next.close()
