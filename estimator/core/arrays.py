"""Array types."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    pass


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
