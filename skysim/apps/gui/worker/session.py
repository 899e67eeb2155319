"""A tab's worker: a process that has a desk, asked over a pipe, one thing at a time; the page never waits for it."""

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

CAREFUL = {"OPENCV_IO_MAX_IMAGE_PIXELS": str(2**27)}  # of a picture that is unpacked


class Gone(Exception):
    """The worker died or was closed."""


def serve(pipe: Connection, progress: Any, stop: Any) -> None:
    """The worker: (task, arguments) in, ("ok", answer) or ("bad", message) out, until the pipe closes.

    progress : shared, two numbers: how much is done of how much;  stop : shared, not 0 where the task is to end
    """
    from skysim.apps.gui.worker.tasks import TASKS, Kept, Stopped

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's, which closes the pipe

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
        except Exception as error:  # a defect of ours must not end the tab
            pipe.send(("bad", f"{type(error).__name__}: {error}"))


class Session:
    """One tab's process. Calls stand in line."""

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
        """What a task answers. Raises InputError for what the user got wrong, Gone where the worker is no more."""
        return await asyncio.get_running_loop().run_in_executor(self.thread, self.call, task, arguments)

    def call(self, task: str, arguments: tuple[Any, ...]) -> Any:
        """In the session's own thread: send, wait, receive."""
        self.stop.value = 0
        try:
            self.pipe.send((task, arguments))
            verdict, answer = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise Gone("this tab's worker has stopped: reload the page") from error
        if verdict == "bad":
            raise InputError(answer)
        return answer

    def halt(self) -> None:
        """End the task at hand, if it is one that tells its progress."""
        self.stop.value = 1

    @property
    def share(self) -> float:
        """How much of the task at hand is done."""
        done, everything = self.progress[:]
        return done / everything if everything else 0.0

    def close(self) -> None:
        """End the work of a tab that was closed."""
        self.halt()
        self.process.terminate()
        self.process.join(2.0)
        self.pipe.close()
        self.thread.shutdown(wait=False, cancel_futures=True)


class Spare:
    """A worker begun ahead of the next tab: what it imports and compiles takes seconds.

    scene : the file that it looks at once, to have done everything before
    """

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.next: Session | None = None

    def begin(self) -> None:
        """One, if there is none."""
        if self.next is None:
            self.next = Session()
            self.next.thread.submit(self.next.call, "warm", (self.scene,))

    def take(self) -> Session:
        """The spare, else a new one."""
        found, self.next = self.next, None
        return found if found and found.process.is_alive() else Session()

    def end(self) -> None:
        """The server ends."""
        if self.next:
            self.next.close()
