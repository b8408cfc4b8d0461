from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import pytest


@pytest.fixture(scope="session")
def entry() -> Callable[[Any], Callable[..., Any]]:
    """Makes a function that Python can call of one that only compiled ones can."""
    return cache(lambda function: numba.njit(lambda *args: function(*args)))
