"""Problems in a data store, split by scene; 50,000 of them are open at once."""

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
from bpnp.datamodules.store import Store, StoreError, StoreRow, new_store, open_store
from bpnp.files import read_lines
from bpnp.poses import MIN_POINTS
from bpnp.types import Batch

PROBLEMS = "problems"  # kind of a store of problems
WIDTHS = {"points2d": 2, "points3d": 3}


def write_problems(
    folder: Path, problems: Iterable[tuple[str, Problem]], *, parameters: Mapping[str, Any] | None = None
) -> None:
    """Write problems into a new store, for `StoredDataModule(root=folder)`.

    An interrupted run leaves no store.

    Args:
        folder: New folder.
        problems: Pairs (scene, problem); a split keeps the problems of a scene together.
        parameters: JSON content for the manifest. None for no additional content.

    Raises:
        StoreError: The folder exists, there are no problems, or points have another number of coordinates.
    """
    with new_store(folder, PROBLEMS, WIDTHS) as writer:
        for scene, problem in problems:
            writer.add(*problem_row(scene, problem))
        if not len(writer):
            raise StoreError(f"there are no problems to write into {folder}; give at least one")
        writer.parameters |= parameters or {}


def problem_row(scene: str, problem: Problem) -> StoreRow:
    """Return the row of a store that holds a problem."""
    columns = {name: getattr(problem, name) for name in ("matched", "focal", "rotation", "translation")}
    origin = np.zeros(3) if problem.origin is None else problem.origin
    return problem.name, {name: getattr(problem, name) for name in WIDTHS}, columns | {"scene": scene, "origin": origin}


def stored_problem(store: Store, row: int) -> Problem:
    """Return the problem in a row; its points are views of the mapped files."""
    points, columns = store.row(row), {name: column[row] for name, column in store.columns.items()}
    pose, matched = (columns["rotation"], columns["translation"]), int(columns["matched"])
    focal, origin = float(columns["focal"]), columns["origin"]
    return Problem(store.name(row), points["points2d"], points["points3d"], matched, *pose, focal, origin)


def scene_rows(store: Store) -> dict[str, NDArray[np.int64]]:
    """Return the rows of each scene; scenes are in the order of their first row."""
    names, first, scene = np.unique(store.columns["scene"], return_index=True, return_inverse=True)
    return {bytes(names[i]).decode(): np.flatnonzero(scene == i) for i in np.argsort(first)}


class StoredProblems:
    """Source of problems in rows of a store; StoreError if none has `min_points` matches."""

    def __init__(self, store: Store, rows: NDArray[np.int64], *, min_points: int) -> None:
        self.store = store
        self.rows = rows[has_enough_matches(store.columns["matched"][rows], min_points, str(store.folder))]

    @property
    def counts(self) -> Counts:
        """Numbers of points of each problem."""
        matched = self.store.columns["matched"][self.rows]
        return Counts(matched, *(self.store.counts(name)[self.rows] for name in WIDTHS))

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        """Return problems; see `ProblemSource.batch`."""
        return stack_problems([stored_problem(self.store, int(self.rows[i])) for i in index.tolist()], index)


class StoredDataModule(ProblemDataModule):
    """Problems from `write_problems`, or from `bpnp prepare` of COLMAP models, split by scene.

    Scenes are split, not images, so that no landmark is both trained and tested on, as in Campbell et al. (ECCV 2020).
    Works without a Trainer: `setup()`, then the loaders.

    Args:
        root: Folder of the store.
        train_scenes: Scenes to train on, or a text file with one a line; None for all scenes that the others leave.
        val_scenes: Scenes to validate on, or a file; None to draw val_fraction.
        test_scenes: Scenes to test and predict on, or a file; None to draw test_fraction.
        val_fraction: Fraction of the scenes to validate on, drawn by seed.
        test_fraction: Fraction of the scenes to test and predict on, drawn by seed; 1 for all.
        min_points: Images that see fewer points are skipped; at least 4.
        max_points: Largest number of matches of a training image; of more, a random subset is taken. None for all.
        fresh_subsets: Draw new subsets, clutter and rotations every epoch in training.
        eval_max_points: As max_points, in validation, testing and prediction, where the subset is fixed; None for all.
        clutter: Natural clutter, as a ratio to the matches: keypoints without a 3D point, and points of the scene that
            the image does not see.
        clutter_side: Side that gets clutter: "both", "2d" or "3d".
        rotate: Rotate the scene of each problem at random; never in prediction.
        **loading: Options of `ProblemDataModule`: train_outliers, test_outliers, batch_size, eval_batch_size,
            max_cells, num_workers and seed.
    """

    def __init__(
        self,
        root: str,
        *,
        train_scenes: list[str] | list[int] | str | None = None,
        val_scenes: list[str] | list[int] | str | None = None,
        test_scenes: list[str] | list[int] | str | None = None,
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
            raise ValueError(
                f"`min_points` is {min_points}; it must be {MIN_POINTS} or more, since fewer do not determine a pose"
            )
        for option, most in (("max_points", max_points), ("eval_max_points", eval_max_points)):
            if most is not None and most < min_points:
                raise ValueError(f"`{option}` is {most}; it must be at least `min_points`, {min_points}")
        if not clutter < np.inf:
            raise ValueError(f"`clutter` is {clutter}; it must be finite, such as 0.5, which adds half as many points")
        self.root, self.min_points, self.clutter, self.fresh = root, min_points, clutter, fresh_subsets
        training = Augmentation(max_points, clutter, clutter_side, rotate)
        evaluation = replace(training, max_points=eval_max_points)
        self.augmentations = {"train": training, "val": evaluation, "test": evaluation}
        self.augmentations["predict"] = replace(evaluation, rotate=False)
        lists = {"train": train_scenes, "val": val_scenes, "test": test_scenes}
        self.splitting: dict[str, Any] = {"val_fraction": val_fraction, "test_fraction": test_fraction}
        self.splitting |= {part: _scene_list(f"{part}_scenes", scenes) for part, scenes in lists.items()}

    def setup(self, stage: str | None = None) -> None:
        """Open the scenes of a stage: fit, validate, test or predict; None for all.

        Raises:
            ValueError: The store or the models cannot be used, the split does not fit the scenes, or the stage has no
                scenes (fit does without validation scenes).
        """
        self.scenes = self._open()
        self.split = split_scenes(list(self.scenes), **self.splitting, seed=self.seed)
        super().setup(stage)
        if stage is not None and STAGES[stage][0] not in self.datasets:
            name = stage.value if isinstance(stage, TrainerFn) else stage
            raise ValueError(
                f"no scene is left for {name} of {', '.join(self.scenes)}; name scenes in the *_scenes arguments, or "
                "change the fractions"
            )

    def _source(self, split: str, seed: tuple[int, int]) -> ProblemSource | None:
        """Return the problems of a split's scenes; None if it has no scenes."""
        scenes = [self.scenes[scene] for scene in self.split[split]]
        return self._problems(scenes, seed) if scenes else None

    def _open(self) -> dict[str, Any]:
        """Return the input of `_problems` for each scene, by its name."""
        self.store = open_store(self.root, PROBLEMS)
        if self.clutter > (stored := self.store.parameters.get("clutter", np.inf)):
            raise StoreError(
                f"`clutter` is {self.clutter}, but {self.root} was made with {stored}; use at most that, or prepare it "
                f"again with --clutter {self.clutter}"
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
    """Divide scenes among "train", "val" and "test" without overlap.

    Lists that are given are taken unchanged. The remaining scenes are shuffled by `seed`, and where a list is None it
    gets its fraction of all scenes: first test, then val, at least one unless the fraction is 0 (val only if one is
    left to train); train gets the rest. Raise ValueError if a name is not in `scenes`, a scene is in two lists, or a
    fraction is outside [0, 1].
    """
    split = {part: list(names) for part, names in (("train", train), ("val", val), ("test", test)) if names is not None}
    fractions = {"test": test_fraction, "val": val_fraction}
    named = [name for names in split.values() for name in names]
    if unknown := [name for name in named if name not in scenes]:
        raise ValueError(f"there are no scenes {', '.join(unknown)}; the scenes are {', '.join(scenes)}")
    if twice := sorted({name for name in named if named.count(name) > 1}):
        raise ValueError(f"the lists of scenes name {', '.join(twice)} more than once")
    check_within(0, 1, test_fraction=test_fraction, val_fraction=val_fraction)
    rest = sorted(set(scenes) - set(named))
    rest = [rest[i] for i in np.random.default_rng(seed).permutation(len(rest))]
    for part, fraction in fractions.items():
        if part not in split:
            count = max(round(fraction * len(scenes)), fraction > 0)
            count = min(count, len(rest) - (part == "val" and train is None)) if rest else 0
            split[part], rest = sorted(rest[:count]), rest[count:]
    return {"train": sorted(rest), **split}


def has_enough_matches(matched: NDArray[np.int64], min_points: int, where: str) -> NDArray[np.int64]:
    """Return the indices of problems with `min_points` matches or more of their numbers (k,), and warn of the others.

    Raise StoreError if there is none.
    """
    large = np.flatnonzero(matched >= min_points)
    if not len(large):
        raise StoreError(
            f"none of the {len(matched)} problems in {where} has {min_points} or more matches; use a smaller "
            "`min_points` or other scenes"
        )
    if skipped := len(matched) - len(large):
        message = f"skipped {skipped} of {len(matched)} problems of {where}: fewer than {min_points} matches"
        warnings.warn(message, stacklevel=3)
    return large


def _scene_list(name: str, scenes: list[str] | list[int] | str | None) -> list[str] | None:
    """Return the scenes of a list, or of the lines of a text file.

    Raise ValueError if a name is a number, as YAML reads digits without quotes; or the file is missing or empty.
    """
    if scenes is None:
        return None
    if not isinstance(scenes, str):
        names = [scene for scene in scenes if isinstance(scene, str)]
        if numbers := [scene for scene in scenes if not isinstance(scene, str)]:
            raise ValueError(
                f'`{name}` holds the number {numbers[0]}; give names in quotes, such as ["0015"], which YAML reads as '
                "the number 13 without them"
            )
        return names
    path = Path(scenes)
    if not path.is_file():
        raise ValueError(f"there is no file {path}; `{name}` is a list of scenes, or a text file with one a line")
    lines = read_lines(path)
    if not lines:
        raise ValueError(f"{path} is empty; `{name}` needs a file with one scene a line")
    return lines
