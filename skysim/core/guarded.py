"""Run a script on an untrusted file in a child process with limits, since C libraries may crash, hang or fill memory.

The child is `python -P -m skysim.core.guarded CPU_S MEMORY_BYTES SCRIPT ARGUMENTS`. It imports this module, then
the script as a file, without the packages that contain it.
"""

import os
import runpy
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

# Python without the working directory on its import path: a stranger's folder may hold a module signal.py.
PYTHON = (sys.executable, "-P")
SAFE_PATH = "PYTHONSAFEPATH"  # environment variable that does the same
# Value of MUJOCO_GL with which MuJoCo imports no OpenGL, whose library runs Python in the working directory.
GL_OFF = "off"
WALL_S = 15.0  # elapsed time, for a child that waits, or on a loaded machine
MESSAGE_BYTES = 1000  # of the child's standard error that are read
# One thread: the stacks and arenas of a pool for many cores would exceed the memory limit.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def run_guarded(script: Path, *arguments: str, cpu_s: int, memory_bytes: int) -> str:
    """Run a script to its end; return "" on success, else the reason of the failure in one line.

    Parameters
    ----------
    script, arguments
        Script and its arguments
    cpu_s
        Limit of processor time, including start-up
    memory_bytes
        Limit of address space, including libraries
    """
    limits = (str(cpu_s), str(memory_bytes))
    command = [*PYTHON, "-m", __name__, *limits, str(script), *arguments]
    with tempfile.TemporaryFile() as errors:
        try:
            code = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=dict(os.environ) | ONE_THREAD,
                timeout=WALL_S,
            ).returncode
        except subprocess.TimeoutExpired:
            return f"it takes longer than {WALL_S:g} s"
        errors.seek(max(errors.tell() - MESSAGE_BYTES, 0))
        lines = errors.read().decode(errors="replace").strip().splitlines()
    if code == -signal.SIGXCPU:
        return f"it takes more than {cpu_s} s"
    if code < 0:
        return f"it crashes its reader ({signal.Signals(-code).name})"
    if code == 0:
        return ""
    return lines[-1] if lines else f"its reader exits with code {code}"


def main() -> None:
    """Main function of the child: set the limits, then run the script with its arguments."""
    import resource  # not available on every system, and not needed by the parent

    cpu_s, memory_bytes, script, *arguments = sys.argv[1:]
    # A system may not have a limit, or have a lower one.
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_AS, (int(memory_bytes),) * 2)
    with suppress(ValueError, OSError):
        # At the hard limit the signal is SIGKILL, which a system without memory sends too.
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_s), int(cpu_s) + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.argv = [script, *arguments]
    try:
        runpy.run_path(script, run_name="__main__")
    except MemoryError:
        sys.exit(f"it needs more than {int(memory_bytes) >> 20} MiB of memory")


if __name__ == "__main__":
    main()
