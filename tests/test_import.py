"""What `import bpnp` and the first `solve` load: nothing that they do not use."""

import subprocess
import sys

import pytest

import bpnp

HEAVY = ("roma", "torch._dynamo", "lightning", "wandb", "bpnp.models", "sympy")


def loaded(statements: str, names: tuple[str, ...]) -> list[str]:
    """Which of the modules `names` are loaded after `statements` in a new interpreter."""
    ask = f"import sys\n{statements}\nprint(*[name for name in {names} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True).stdout.split()


def test_importing_the_package_loads_neither_compilers_nor_optimisers() -> None:
    assert loaded("import bpnp", (*HEAVY, "scipy.optimize", "numba")) == []


def test_solving_two_arrays_loads_neither_networks_nor_torchs_compiler() -> None:
    assert loaded("from bpnp import solve, solve_many, PosePrior, GravityPrior, Solution, Batch", HEAVY) == []
    assert loaded("from bpnp import BPnPNet", HEAVY) != []  # the check sees what is loaded


@pytest.mark.parametrize("name", bpnp.__all__)
def test_every_public_name_is_found_and_listed(name: str) -> None:
    assert getattr(bpnp, name).__name__ == name
    assert name in dir(bpnp)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'bpnp' has no attribute 'solver'"):
        bpnp.solver  # noqa: B018
