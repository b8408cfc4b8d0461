"""Types of NumPy arrays in annotations."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]
Array32 = NDArray[np.float32]
Indices = NDArray[np.int64]
Labels = NDArray[np.int64]
AnyArray = NDArray[Any]
PoseArrays = tuple[Array, Array]  # rotation (3, 3), translation (3,): camera = R p + t
