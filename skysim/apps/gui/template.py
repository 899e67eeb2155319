"""The worker from which the workers of the tabs are forked; the fork server of the GUI preloads this module.

It imports the code, loads compiled functions and sets up the scene that pages open first. This takes seconds; a fork is
ready in milliseconds and shares the memory.
"""

from __future__ import annotations

import gc
import os
from contextlib import suppress
from typing import TYPE_CHECKING

from skysim.apps.gui.worker.session import SCENE

if TYPE_CHECKING:
    from skysim.apps.gui.worker.tasks import Worker

THREADS = min(
    os.cpu_count() or 1, 2
)  # threads that render a frame, so that a key is answered sooner
# These are set before the libraries are imported. OpenMP's threads do not survive a fork, numba's own do. OpenCV
# refuses larger images.
ENVIRONMENT = {
    "NUMBA_NUM_THREADS": str(THREADS),
    "NUMBA_THREADING_LAYER": "workqueue",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENCV_IO_MAX_IMAGE_PIXELS": str(2**27),
}


def make_worker() -> Worker:
    """A worker that has set up the scene and solved a frame; without a scene if it cannot be set up."""
    os.environ.update(ENVIRONMENT)
    import cv2

    from skysim.apps.gui.worker.tasks import Worker
    from skysim.core.errors import InputError

    cv2.setNumThreads(1)
    worker = Worker()
    scene = os.environ.get(SCENE)
    if scene:
        with suppress(InputError):
            worker.warm_up(scene)
    gc.collect()
    gc.freeze()  # the collector would write to pages that the forks share
    return worker


WORKER = make_worker()
