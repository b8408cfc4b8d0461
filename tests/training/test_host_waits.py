"""Where a training step makes the host wait for a device: the places are listed, so that none is added unseen."""

import ast
import subprocess
import sys
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from small_data import small_net
from torch.utils._python_dispatch import TorchDispatchMode

import bpnp
import bpnp.layers.compiled
from bpnp import Batch
from bpnp.layers import RansacPnP
from bpnp.training.task import BlindPnPTask

PACKAGE = Path(bpnp.__file__).parent
METHODS, FUNCTIONS = {"item", "cpu", "tolist", "numpy", "nonzero"}, {"bool", "int", "float"}
FILES = [
    PACKAGE / "types.py",
    *sorted((PACKAGE / "layers").glob("*.py")),
    *sorted((PACKAGE / "models/nets").glob("*.py")),
    *(PACKAGE / f"models/{name}.py" for name in ("bpnpnet", "matcher")),
    *(PACKAGE / f"training/{name}.py" for name in ("losses",)),
]
# Calls that may read a value back, by function.
READS = {
    "layers/laplacian.py:_solve": 1,  # float64: whether anything stalled
    "layers/laplacian.py:solve_multipliers": 2,  # whether a sample needs float64, and which
    "layers/assignment.py:check_mu": 1,  # in an error
    "layers/assignment.py:sinkhorn": 1,  # whether a given mask has a real point in every sample
    "layers/compiled.py:conjugate_gradients": 1,  # on the CPU only
    "layers/compiled.py:first_sums": 2,  # on the CPU only
    "layers/compiled.py:work": 1,  # of the one before
    "layers/implicit.py:record": 1,  # unconverged backward passes
    "layers/laplacian.py:conjugate_gradients": 1,  # the end, every eighth iteration
    "layers/laplacian.py:solve_laplacian": 2,  # float64: what to factorise
    "layers/objective.py:lbfgs": 1,  # the paper's solver, an option
    "layers/objective.py:newton": 1,  # the end, each iteration
    "layers/plan.py:degree": 1,  # whether differences have lost their digits
    "layers/ransac.py:top_matches": 1,  # of numbers of the host
    "layers/transport.py:_absorb": 3,
    "layers/transport.py:_anneal": 1,
    "layers/transport.py:_range": 1,
    "layers/transport.py:_solve": 2,  # the end, and which samples go on
    "layers/transport.py:solve_plan": 2,  # which samples need float64
    "layers/transport.py:sweep": 1,
    "models/nets/pointwise.py:norm_gradient": 1,  # on the CPU only
    "models/nets/pointwise.py:normalise": 1,  # on the CPU only
    "models/nets/normalisation.py:_of_real_points": 1,  # on the CPU only
    "types.py:unpadded": 1,  # on the CPU only
}
ATEN = torch.ops.aten
WAITING = {ATEN._local_scalar_dense, ATEN.nonzero, ATEN.masked_select, ATEN.equal}
IMPLICIT = {"layers/assignment.py:check_mu"}  # `not mu > 0`, of a mu on the device


class Waits(TorchDispatchMode):
    """Notes the function of this package in which a value, or a size that depends on values, is asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.places: set[str] = set()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        by_mask = function.overloadpacket is ATEN.index and any(
            i is not None and i.dtype == torch.bool for i in args[1]
        )
        if function.overloadpacket in WAITING or by_mask:
            frames = [f for f in traceback.extract_stack() if f.filename.startswith(f"{PACKAGE}/")]
            if frames:
                self.places.add(f"{frames[-1].filename.removeprefix(f'{PACKAGE}/')}:{frames[-1].name}")
        return function(*args, **(kwargs or {}))


def test_the_calls_that_read_a_value_back_are_listed() -> None:
    found: Counter[str] = Counter()
    for file in FILES:
        functions = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.FunctionDef)]
        for function in functions:
            for node in ast.walk(function):
                if isinstance(node, ast.Call):
                    method = isinstance(node.func, ast.Attribute) and node.func.attr in METHODS
                    builtin = isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS
                    found[f"{file.relative_to(PACKAGE).as_posix()}:{function.name}"] += method or builtin
    assert +found == READS


@pytest.mark.parametrize("pose_weight", [0.0, 1.0])
def test_a_training_step_waits_at_no_other_place(pose_weight: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bpnp.layers.compiled, "applies_to", lambda tensor: False)  # as on a GPU
    net = small_net()
    net.ransac = RansacPnP(backend="torch", max_iterations=50)
    task = BlindPnPTask(net, pose_weight=pose_weight)
    points3d = torch.randn(2, 20, 3)
    camera = points3d + torch.tensor([0.0, 0.0, 5.0])
    shift, pairs = torch.tensor([0.0, 0.0, 5.0]), [torch.arange(20)] * 2
    poses = [torch.eye(3)] * 2, [shift] * 2
    batch = Batch.from_arrays(list(camera[..., :2] / camera[..., 2:]), list(points3d), *poses, pairs)
    task.log_dict = lambda *args, **options: None
    with Waits() as waits:
        task.training_step(batch, 0).backward()
    own = {place for place in waits.places if not place.startswith("robust/")}
    assert own <= READS.keys() | IMPLICIT
    assert "layers/transport.py:_solve" in own


# The batch norms of two samples in the input transform amplify rounding, to 1e-4 here.
ONE_GRAPH = """
import torch
from bpnp import Batch, BPnPNet
from bpnp.models.nets import ImageFeatures, SceneFeatures
torch.manual_seed(0)
net = BPnPNet(ImageFeatures(channels=16, depth=2), SceneFeatures(channels=16, depth=2))
batch = Batch.from_arrays([torch.rand(9, 2), torch.rand(6, 2)], [torch.rand(7, 3), torch.rand(8, 3)])
for training in (True, False):
    net.train(training)
    compiled = torch.compile(net.features, fullgraph=True, backend="eager")
    for ours, graph, mask in zip(net.features(batch), compiled(batch), (batch.mask2d, batch.mask3d)):
        torch.testing.assert_close(graph[mask], ours[mask], atol=5e-3, rtol=0)
"""


def test_the_nets_are_one_graph_whatever_the_mask() -> None:
    """In a process of its own: the type checks of the tests' own imports are no graph."""
    subprocess.run([sys.executable, "-c", ONE_GRAPH], check=True, timeout=300)
