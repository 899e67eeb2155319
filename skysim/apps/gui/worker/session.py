"""Session of a tab: a worker process that runs tasks one at a time, driven over a pipe without blocking the page."""

from __future__ import annotations

import asyncio
import importlib
import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, ClassVar

from estimator.core.errors import ImageError
from skysim.core.errors import InputError
from skysim.core.guarded import SAFE_PATH

if TYPE_CHECKING:  # the template sets the environment of numba before it is imported
    from skysim.apps.gui.messages import Display

TEMPLATE = "skysim.apps.gui.template"  # module of the worker from which the others are forked
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload([TEMPLATE])
SCENE = "SKYSIM_GUI_SCENE"  # environment variable: the scene that the template of the workers sets up
STOPPED = "the worker of this page has stopped"
QUEUE_S = 0.2  # interval of looking for a free worker


class WorkerLost(Exception):
    """The worker has died or was closed."""


def serve(pipe: Connection) -> None:
    """Main loop of the worker, until the pipe closes.

    It receives (task, arguments, display), and sends the result or an InputError.
    """
    worker = importlib.import_module(TEMPLATE).WORKER
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C is for the server, which closes the pipe
    while True:
        try:
            task, arguments, worker.display = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            pipe.send(getattr(worker, task)(*arguments))
        except InputError as error:
            pipe.send(error)
        except ImageError as error:
            pipe.send(InputError("", error))
        except MemoryError:
            pipe.send(InputError("", "not enough memory"))
        except Exception as error:  # a bug in one task must not end the worker
            pipe.send(InputError("", f"{type(error).__name__}: {error}"))


class Session:
    """One tab's worker process. Calls are queued and run one at a time.

    Attributes
    ----------
    display
        Display of the browser, for which the worker makes frames; None if it is not known yet
    alive
        All sessions that are not closed
    """

    display: Display | None = None
    alive: ClassVar[set[Session]] = set()

    def __init__(self) -> None:
        self.pipe, self.worker_pipe = CONTEXT.Pipe()
        self.process = CONTEXT.Process(target=serve, args=(self.worker_pipe,), daemon=True)
        self.thread = ThreadPoolExecutor(1, "session")
        self.thread.submit(self.start)
        Session.alive.add(self)

    def start(self) -> None:
        """Fork the worker; waits until the template is ready."""
        with self.worker_pipe:
            try:
                self.process.start()
            except EOFError:  # the template has just ended: the next call starts another one
                self.process.start()

    async def run(self, task: str, *arguments: Any) -> Any:
        """Run a task and return its result. Raises InputError for a user error, WorkerLost if the worker has ended."""
        try:
            return await asyncio.get_running_loop().run_in_executor(
                self.thread, self.call, task, arguments
            )
        except (RuntimeError, asyncio.CancelledError) as error:
            if self in Session.alive:
                raise
            raise WorkerLost(STOPPED) from error

    def call(self, task: str, arguments: tuple[Any, ...]) -> Any:
        """Send a task and wait for its result; runs in the session's thread."""
        try:
            self.pipe.send((task, arguments, self.display))
            reply = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise WorkerLost(STOPPED) from error
        if isinstance(reply, InputError):
            raise reply
        return reply

    def close(self) -> None:
        """End the worker; may take seconds."""
        Session.alive.discard(self)
        if self.process.pid:
            self.process.terminate()
            self.process.join(2.0)
        self.pipe.close()  # this also ends a worker that is just starting
        self.thread.shutdown(wait=False, cancel_futures=True)


class Workers:
    """The workers of all tabs.

    Attributes
    ----------
    limit
        Maximum number of workers
    queue
        Tabs that wait for a worker, first come first
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.queue = list[object]()

    @staticmethod
    def prepare(scene: str) -> None:
        """Start the process from which workers are forked, see `template`.

        Parameters
        ----------
        scene
            File of the scene that it sets up
        """
        os.environ |= {SCENE: scene, SAFE_PATH: "1"}
        forkserver.ensure_running()

    def take(self) -> Session | None:
        """A new worker; None if the limit is reached."""
        return Session() if len(Session.alive) < self.limit else None

    async def wait(
        self, wanted: Callable[[], bool], tell: Callable[[str], None]
    ) -> Session | None:
        """A new worker when it is this tab's turn; None if the tab no longer wants one.

        Parameters
        ----------
        tell
            Function that is called with a text on what the tab waits for
        """
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
