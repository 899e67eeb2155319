"""Session of a tab: a worker process that runs tasks one at a time, driven over a pipe without blocking the page."""

from __future__ import annotations

import asyncio
import multiprocessing
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, ClassVar

from estimator.core.errors import ImageError
from skysim.core.errors import InputError
from skysim.experiments.study.execution.workers import environment, one_thread

QUEUE_S = 0.2  # between two looks for a free worker
RENEW_S = 1.0  # for the last task of a tab that was closed
OPENCV_LIMITS = {"OPENCV_IO_MAX_IMAGE_PIXELS": str(2**27)}  # environment: OpenCV refuses larger images


class WorkerLost(Exception):
    """The worker has died or was closed."""


def serve(pipe: Connection) -> None:
    """Main loop of the worker: receives (task, arguments), sends ("ok", result) or ("error", message), until the pipe
    closes.
    """
    from skysim.apps.gui.worker.tasks import Worker

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which closes the pipe
    worker = Worker()
    while True:
        try:
            task, arguments = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            pipe.send(("ok", getattr(worker, task)(*arguments)))
        except (InputError, ImageError) as error:
            pipe.send(("error", str(error)))
        except MemoryError:
            pipe.send(("error", "not enough memory"))
        except Exception as error:  # a bug in one task must not end the tab
            pipe.send(("error", f"{type(error).__name__}: {error}"))


class Session:
    """One tab's worker process. Calls are queued and run one at a time.

    alive : all that are not closed
    """

    alive: ClassVar[set[Session]] = set()

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, worker_pipe = context.Pipe()
        self.process = context.Process(target=serve, args=(worker_pipe,), daemon=True)
        with one_thread(), environment(OPENCV_LIMITS):
            self.process.start()
        worker_pipe.close()
        self.thread = ThreadPoolExecutor(1, "session")
        Session.alive.add(self)

    async def run(self, task: str, *arguments: Any) -> Any:
        """Run a task and return its result. Raises InputError for a user error, WorkerLost if the worker has ended."""
        return await asyncio.get_running_loop().run_in_executor(self.thread, self.call, task, arguments)

    def call(self, task: str, arguments: tuple[Any, ...]) -> Any:
        """Send a task and wait for its result; runs in the session's thread."""
        try:
            self.pipe.send((task, arguments))
            status, reply = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise WorkerLost("the worker of this page has stopped") from error
        if status == "error":
            raise InputError(reply)
        return reply

    async def renew(self) -> bool:
        """Make the worker as new for another tab; False if it has ended or does not finish its task soon."""
        try:
            await asyncio.wait_for(self.run("renew"), RENEW_S)
        except (TimeoutError, WorkerLost):
            return False
        return True

    def close(self) -> None:
        """End the worker; may take seconds."""
        Session.alive.discard(self)
        self.process.terminate()
        self.process.join(2.0)
        self.pipe.close()
        self.thread.shutdown(wait=False, cancel_futures=True)


class SpareWorker:
    """Keeps a worker ready for the next tab, because its imports and compilation take seconds.

    scene : file from which it solves a frame to warm up
    limit : of workers at once, the spare one included
    queue : of the tabs that wait for one, the first first
    """

    def __init__(self, scene: str, limit: int) -> None:
        self.scene, self.limit = scene, limit
        self.next: Session | None = None
        self.queue = list[object]()

    def start(self) -> None:
        if self.next is None and not self.queue and len(Session.alive) < self.limit:
            self.next = Session()
            self.next.thread.submit(self.next.call, "warm_up", (self.scene,))

    def take(self) -> Session | None:
        """Return the spare worker, or else a new one; None if there are as many as the limit already."""
        session, self.next = self.next, None
        if session and session.process.is_alive():
            return session
        if session:
            session.close()
        return Session() if len(Session.alive) < self.limit else None

    async def take_back(self, session: Session) -> None:
        """A tab was closed: its worker is for the next tab that waits, since starting another takes seconds; else end
        it."""
        if self.queue and self.next is None and await session.renew() and self.next is None:
            self.next = session
        else:
            await asyncio.to_thread(session.close)

    async def wait(self, wanted: Callable[[], bool], tell: Callable[[str], None]) -> Session | None:
        """`take`, once it is this tab's turn; None if none is wanted any more. tell : gets what it waits for"""
        ticket = object()
        self.queue.append(ticket)
        try:
            while wanted():
                place = self.queue.index(ticket)
                session = None if place else self.take()
                if session:
                    return session
                before = f"; {place} before this page" if place else ""
                tell(f"{self.limit} of {self.limit} workers in use{before}.")
                await asyncio.sleep(QUEUE_S)
            return None
        finally:
            self.queue.remove(ticket)

    def close(self) -> None:
        if self.next:
            self.next.close()
