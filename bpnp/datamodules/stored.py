"""Problems in a data store: 50,000 of them open at once, split by scene."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from lightning.pytorch.trainer.states import TrainerFn
from numpy.typing import NDArray
from torch import Tensor

from bpnp.checks import check_within
from bpnp.datamodules.augment import Augmentation, Side
from bpnp.datamodules.loader import STAGES, ProblemDataModule
from bpnp.datamodules.problem import Counts, Problem, ProblemSource, stack_problems
from bpnp.datamodules.store import Row, Store, StoreError, new_store, open_store
from bpnp.poses import MIN_POINTS
from bpnp.types import Batch

PROBLEMS = "problems"  # the kind of such a store
WIDTHS = {"points2d": 2, "points3d": 3}


def write_problems(
    folder: Path, problems: Iterable[tuple[str, Problem]], *, parameters: Mapping[str, Any] | None = None
) -> None:
    """Write (scene, problem) after (scene, problem) into the new store `folder`, for `StoredDataModule(root=folder)`.

    parameters: kept in the manifest, must be JSON.
    Raises StoreError if the folder exists; what is not complete is not there at all.
    """
    with new_store(folder, PROBLEMS, WIDTHS) as writer:
        for scene, problem in problems:
            writer.add(*problem_row(scene, problem))
        writer.parameters |= parameters or {}


def problem_row(scene: str, problem: Problem) -> Row:
    """The row of a store that keeps a problem."""
    columns = {name: getattr(problem, name) for name in ("matched", "focal", "rotation", "translation")}
    origin = np.zeros(3) if problem.origin is None else problem.origin
    return problem.name, {name: getattr(problem, name) for name in WIDTHS}, columns | {"scene": scene, "origin": origin}


def stored_problem(store: Store, row: int) -> Problem:
    """The problem in a row; its points are views of the mapped files."""
    points, columns = store.row(row), {name: column[row] for name, column in store.columns.items()}
    pose, matched = (columns["rotation"], columns["translation"]), int(columns["matched"])
    focal, origin = float(columns["focal"]), columns["origin"]
    return Problem(store.name(row), points["points2d"], points["points3d"], matched, *pose, focal, origin)


def scene_rows(store: Store) -> dict[str, NDArray[np.int64]]:
    """The rows of each scene, scenes in the order of their first row."""
    names, first, scene = np.unique(store.columns["scene"], return_index=True, return_inverse=True)
    return {bytes(names[i]).decode(): np.flatnonzero(scene == i) for i in np.argsort(first)}


class StoredProblems:
    """A `ProblemSource`: rows of a store of problems. Raises ValueError as `has_enough_matches`."""

    def __init__(self, store: Store, rows: NDArray[np.int64], *, min_points: int) -> None:
        self.store = store
        self.rows = rows[has_enough_matches(store.columns["matched"][rows], min_points, str(store.folder))]

    @property
    def counts(self) -> Counts:
        matched = self.store.columns["matched"][self.rows]
        return Counts(matched, *(self.store.counts(name)[self.rows] for name in WIDTHS))

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        return stack_problems([stored_problem(self.store, int(self.rows[i])) for i in index.tolist()], index)


class StoredDataModule(ProblemDataModule):
    """Problems that `write_problems` wrote, or `bpnp prepare` of COLMAP models, split by scene.

    Scenes are split, not images, so that no landmark is both trained and tested on, as in Campbell et al. (ECCV 2020).
    Works without a Trainer: `setup()`, then the loaders.

    Args:
        root: folder of the store.
        train_scenes: scenes to train on, or a text file with one a line; none for all that are left by the others.
        val_scenes: scenes to validate on, or a file; none to draw val_fraction.
        test_scenes: scenes to test and predict on, or a file; none to draw test_fraction.
        val_fraction: share of the scenes to validate on, drawn by seed.
        test_fraction: share of the scenes to test and predict on, drawn by seed; 1 for all.
        min_points: images that see fewer points are skipped; at least 4.
        max_points: largest number of matches of a training image, a random subset of more; none for all.
        fresh_subsets: draw new subsets, clutter and rotations every epoch in training.
        eval_max_points: the same in validation, testing and prediction, where it is fixed; none for all.
        clutter: natural clutter, as a ratio to the matches: keypoints without a 3D point, and points of the scene
            that the image does not see.
        clutter_side: the side that gets clutter, both, 2d or 3d.
        rotate: turn the scene of each problem by a random rotation; never in prediction.
        loading: options of `ProblemDataModule`: batch_size, eval_batch_size, train_outliers, test_outliers, seed, ...
    """

    def __init__(
        self,
        root: str,
        *,
        train_scenes: list[str] | str | None = None,
        val_scenes: list[str] | str | None = None,
        test_scenes: list[str] | str | None = None,
        val_fraction: float = 0.1,
        test_fraction: float = 0.2,
        min_points: int = 4,
        max_points: int | None = 1000,
        fresh_subsets: bool = True,
        eval_max_points: int | None = None,
        clutter: float = 0.0,
        clutter_side: Side = "both",
        rotate: bool = False,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        if min_points < MIN_POINTS:
            raise ValueError(f"expected `min_points` of {MIN_POINTS} or more, got {min_points}; fewer fix no pose")
        for most in (max_points, eval_max_points):
            if most is not None and most < min_points:
                raise ValueError(f"expected `max_points` of at least `min_points` = {min_points}, got {most}")
        if not clutter < np.inf:
            raise ValueError(f"expected a finite `clutter`, got {clutter}; 0.5 adds half as many points")
        self.root, self.min_points, self.clutter, self.fresh = root, min_points, clutter, fresh_subsets
        training = Augmentation(max_points, clutter, clutter_side, rotate)
        evaluation = replace(training, max_points=eval_max_points)
        self.augmentations = {"train": training, "val": evaluation, "test": evaluation}
        self.augmentations["predict"] = replace(evaluation, rotate=False)
        lists = {"train": train_scenes, "val": val_scenes, "test": test_scenes}
        self.splitting: dict[str, Any] = {"val_fraction": val_fraction, "test_fraction": test_fraction}
        self.splitting |= {part: _scene_list(f"{part}_scenes", scenes) for part, scenes in lists.items()}

    def setup(self, stage: str | None = None) -> None:
        """Open the scenes of a stage (fit, validate, test, predict; none for all).

        Raises ValueError for a store or models that cannot be used, a split that does not fit the scenes, or one that
        leaves none for the stage; fit does without validation scenes.
        """
        self.scenes = self._open()
        self.split = split_scenes(list(self.scenes), **self.splitting, seed=self.seed)
        super().setup(stage)
        if stage is not None and STAGES[stage][0] not in self.datasets:
            name = stage.value if isinstance(stage, TrainerFn) else stage
            raise ValueError(
                f"expected scenes for {name}, got none left of {', '.join(self.scenes)}; try to name them in the "
                "*_scenes arguments, or other fractions"
            )

    def _source(self, split: str, seed: tuple[int, int]) -> ProblemSource | None:
        """The problems of a split's scenes; None if it has no scenes."""
        scenes = [self.scenes[scene] for scene in self.split[split]]
        return self._problems(scenes, seed) if scenes else None

    def _open(self) -> dict[str, Any]:
        """What `_problems` needs of each scene, by its name."""
        self.store = open_store(self.root, PROBLEMS)
        if self.clutter > (stored := self.store.parameters.get("clutter", np.inf)):
            raise StoreError(
                f"expected `clutter` of at most {stored}, what {self.root} was made with, got {self.clutter}; try "
                f"that, or preparing again with --clutter {self.clutter}"
            )
        return scene_rows(self.store)

    def _problems(self, scenes: Sequence[Any], seed: tuple[int, int]) -> ProblemSource:
        return StoredProblems(self.store, np.sort(np.concatenate(scenes)), min_points=self.min_points)


def split_scenes(
    scenes: Sequence[str],
    *,
    train: Sequence[str] | None = None,
    val: Sequence[str] | None = None,
    test: Sequence[str] | None = None,
    val_fraction: float = 0.1,
    test_fraction: float = 0.2,
    seed: int = 0,
) -> dict[str, list[str]]:
    """Deal `scenes` to "train", "val" and "test" without overlap.

    Lists that are given are taken as they are. The scenes in none of them are shuffled by `seed`, and where a list is
    None it gets its share: test, then val, `fraction` of all scenes, at least one if the fraction is not 0 (val only
    if one is left to train), then train the rest.

    Raises ValueError for a name that is not in `scenes`, a scene in two lists, or a fraction outside [0, 1].
    """
    split = {part: list(names) for part, names in (("train", train), ("val", val), ("test", test)) if names is not None}
    fractions = {"test": test_fraction, "val": val_fraction}
    named = [name for names in split.values() for name in names]
    if unknown := [name for name in named if name not in scenes]:
        raise ValueError(f"expected scenes among {', '.join(scenes)}, got {', '.join(unknown)}; try one of those")
    if twice := sorted({name for name in named if named.count(name) > 1}):
        raise ValueError(f"expected each scene once in the lists of scenes, got {', '.join(twice)} more than once")
    check_within(0, 1, test_fraction=test_fraction, val_fraction=val_fraction)
    rest = sorted(set(scenes) - set(named))
    rest = [rest[i] for i in np.random.default_rng(seed).permutation(len(rest))]
    for part, fraction in fractions.items():
        if part not in split:
            share = max(round(fraction * len(scenes)), fraction > 0)
            share = min(share, len(rest) - (part == "val" and train is None)) if rest else 0
            split[part], rest = sorted(rest[:share]), rest[share:]
    return {"train": sorted(rest), **split}


def has_enough_matches(matched: NDArray[np.int64], min_points: int, where: str) -> NDArray[np.int64]:
    """Which problems have `min_points` matches or more; the others are warned about.

    Raises StoreError if there are none.
    """
    large = np.flatnonzero(matched >= min_points)
    if not len(large):
        raise StoreError(
            f"expected problems of {min_points} or more matches in {where}, got none of {len(matched)}; try a "
            "smaller `min_points` or other scenes"
        )
    if skipped := len(matched) - len(large):
        message = f"skipped {skipped} of {len(matched)} problems of {where}: fewer than {min_points} matches"
        warnings.warn(message, stacklevel=3)
    return large


def _scene_list(name: str, scenes: list[str] | str | None) -> list[str] | None:
    """The scenes of a list, or of the lines of a text file."""
    if not isinstance(scenes, str):
        return scenes
    path = Path(scenes)
    if not path.is_file():
        raise ValueError(f"expected `{name}` as a list of scenes or a text file with one a line, got no file {path}")
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    if not lines:
        raise ValueError(f"expected `{name}` to name scenes, got {path} without a line; try none for no list")
    return lines
