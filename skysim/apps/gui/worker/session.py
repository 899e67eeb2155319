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

OPENCV_LIMITS = {"OPENCV_IO_MAX_IMAGE_PIXELS": str(2**27)}  # environment: OpenCV refuses larger images


class WorkerLost(Exception):
    """The worker has died or was closed."""


def serve(pipe: Connection, progress: Any, stop: Any) -> None:
    """Main loop of the worker: receives (task, arguments), sends ("ok", result) or ("error", message), until the pipe
    closes.

    progress : shared (done, total) of the current task;  stop : shared flag; not 0 asks the task to end
    """
    from skysim.apps.gui.worker.tasks import Stopped, Worker

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which closes the pipe

    def report_progress(done: float, total: float) -> None:
        progress[:] = done, total
        if stop.value:
            raise Stopped

    worker = Worker(report_progress)
    while True:
        try:
            task, arguments = pipe.recv()
        except (EOFError, OSError):
            return
        progress[:] = 0.0, 0.0
        try:
            pipe.send(("ok", getattr(worker, task)(*arguments)))
        except Stopped:
            pipe.send(("error", "stopped"))
        except (InputError, ImageError) as error:
            pipe.send(("error", str(error)))
        except MemoryError:
            pipe.send(("error", "not enough memory"))
        except Exception as error:  # a bug in one task must not end the tab
            pipe.send(("error", f"{type(error).__name__}: {error}"))


class Session:
    """One tab's worker process. Calls are queued and run one at a time."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, worker_pipe = context.Pipe()
        self.progress, self.stop = context.RawArray("d", 2), context.RawValue("b")
        self.process = context.Process(target=serve, args=(worker_pipe, self.progress, self.stop), daemon=True)
        with one_thread(), environment(OPENCV_LIMITS):
            self.process.start()
        worker_pipe.close()
        self.thread = ThreadPoolExecutor(1, "session")

    async def run(self, task: str, *arguments: Any) -> Any:
        """Run a task and return its result. Raises InputError for a user error, WorkerLost if the worker has ended."""
        return await asyncio.get_running_loop().run_in_executor(self.thread, self.call, task, arguments)

    def call(self, task: str, arguments: tuple[Any, ...]) -> Any:
        """Send a task and wait for its result; runs in the session's thread."""
        self.stop.value = 0
        try:
            self.pipe.send((task, arguments))
            status, reply = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise WorkerLost("this tab's worker has stopped: reload the page") from error
        if status == "error":
            raise InputError(reply)
        return reply

    def halt(self) -> None:
        """Ask the current task to end; only tasks that report progress do."""
        self.stop.value = 1

    @property
    def progress_fraction(self) -> float:
        """Completed fraction of the current task."""
        done, total = self.progress[:]
        return done / total if total else 0.0

    def close(self) -> None:
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

    def start(self) -> None:
        if self.next is None:
            self.next = Session()
            self.next.thread.submit(self.next.call, "warm_up", (self.scene,))

    def take(self) -> Session:
        """Return the spare worker, or else a new one."""
        session, self.next = self.next, None
        return session if session and session.process.is_alive() else Session()

    def close(self) -> None:
        if self.next:
            self.next.close()
