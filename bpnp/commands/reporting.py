"""`bpnp report`, `view`, `wandb` and `table`: results as tables, pages and figures, and tables of several methods."""

import json
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bpnp.bounded_files import read_bytes
from bpnp.commands.parser import at_least
from bpnp.files import check_outputs, lock_folder, packaged_config, write_text
from bpnp.report.terminal import Paper, console, say

if TYPE_CHECKING:
    from bpnp.cameras import Camera
    from bpnp.report.figures import Lines
    from bpnp.report.points import ProblemPoints
    from bpnp.report.tables import MethodRow
    from bpnp.training.comparison import MethodTest

MOST_FOLDERS = 300  # folders that are searched for results without a question [folders; cost]
VIEW_SIDE = 1000  # longer side of a photo in a figure, pixels
LINES: Mapping[str, "Lines | None"] = {"true": "match3d", "assigned": "assigned3d", "none": None}


def report(
    runs: list[Path],
    *,
    paper: Paper | None = None,
    html: Path | None = None,
    recall: Path | None = None,
    curves: Path | None = None,
    photos: Path | None = None,
    groups: bool = False,
) -> None:
    """Show results side by side as tables; optionally write a page, recall curves and training curves.

    Args:
        runs: folders that `bpnp test` or `bpnp table` wrote, or their runs.
        paper: add the published rows of modelnet40 or megadepth, for orientation.
        html: write a page that needs no network.
        recall: write the recall curves as .png, .jpg, .svg or .pdf.
        curves: write losses and validation of the first run's training as .png, .jpg, .svg or .pdf.
        photos: folder of the photos of COLMAP models, for the page; `images` of each scene by default.
        groups: print the intervals of each class, scene or landmark too, as on the page.
    """
    from bpnp.report.charts import import_plotly
    from bpnp.report.figure_files import check_picture_name, save_figure
    from bpnp.report.figures import recall_curve
    from bpnp.report.groups import differences, group_table, training_configs
    from bpnp.report.intervals import interval_table
    from bpnp.report.page import write_page
    from bpnp.report.results import SUMMARY, read_results
    from bpnp.report.tables import read_runs, results_table

    for picture in (curves, recall):
        if picture is not None:
            check_picture_name(picture)
    check_outputs([html, recall, curves])
    if html is not None:
        import_plotly()  # missing, it is named before anything is written
    named = _runs_in(runs)
    results = {name: read_results(path) for name, path in named.items() if (path / SUMMARY).is_file()}
    if curves is not None:
        from bpnp.report.training_curves import lines_of_training, training_curves
        from bpnp.report.training_run import training_folder

        folder = training_folder(runs[0])
        if folder is None:
            raise ValueError(f"{runs[0]} and the folder above it have no logs of a training; give the folder of a run")
        figure = training_curves(folder, lines_of_training(folder, named, results))
        say(f"wrote {save_figure(figure, curves)}")
    if curves is not None and not (html or recall or results):
        say("the run has no test yet, so there are no tables")
        return
    paths = list(named.values())
    if len(results) < len(paths):
        results = read_runs(paths)  # names the folder without results
    intervals = interval_table(results)
    grouped = group_table(results) if groups else None
    if html is not None:
        from bpnp.commands.photo_files import photo_finder

        page = write_page(paths, html, paper=paper, photos=photo_finder(photos), intervals=intervals, groups=grouped)
        say(f"wrote {page}")
    if recall is not None:
        say(f"wrote {save_figure(recall_curve(paths, paper=paper), recall)}")
    console().print(results_table(results, paper=paper))
    console().print(intervals.split_table())
    if grouped is not None:
        console().print(grouped.split_table())
    elif groups:
        say("--groups: all problems are of one group, or their names have no group before a slash")
    if lines := differences(results, training_configs(named, results)):
        say("The runs differ in:\n" + "\n".join(lines))


def _runs_in(folders: Sequence[Path]) -> dict[str, Path]:
    """Return the results in these folders, as `named_runs`; a large tree is searched only if the user wants it."""
    from bpnp.report.tables import LargeTree, named_runs

    if missing := [folder for folder in folders if not folder.exists()]:
        raise ValueError(f"{missing[0]} does not exist; give a folder that `bpnp test` or `bpnp table` wrote")
    try:
        return named_runs(folders, MOST_FOLDERS)
    except LargeTree as error:
        if not (sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()):
            raise
        sys.stderr.write(f"{str(error).rpartition(';')[0]}.\nSearch all of them for results? [y/N] ")
        sys.stderr.flush()
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            raise ValueError("nothing was searched; name the folders of the tests") from error
        return named_runs(folders)


def view(
    run: Path,
    problems: list[str] | None = None,
    *,
    output: Path | None = None,
    estimate: str | None = None,
    lines: Literal["true", "assigned", "none"] = "true",
    photo: Path | None = None,
    camera: str | None = None,
    photos: Path | None = None,
) -> None:
    """Draw a problem of a test, or a solution: points and cameras in space, and points in the image.

    With a photo, the 3D points are drawn over it as each pose projects them. Of several tests, such as those of
    `bpnp table`, the poses of all are drawn.

    Args:
        run: folder that `bpnp test` or `bpnp table` wrote, or its run; or the JSON of a solution.
        problems: name of a problem, or part of it; the worst by default.
        output: .png, .jpg, .svg or .pdf; RUN/views/PROBLEM.png by default.
        estimate: estimate whose pose projects the 3D points; the first by default.
        lines: which matches to draw.
        photo: photo of the problem; needs --camera.
        camera: camera of the photo: a 3x3 matrix in a file, YAML of ROS or OpenCV, MODEL,PARAMETERS, or a COLMAP model
            that has the photo.
        photos: folder of the photos of the COLMAP models that were tested, in place of --photo and --camera.
    """
    from bpnp.report.figure_files import save_figure
    from bpnp.report.figures import plot_photo, plot_problem
    from bpnp.report.images import read_photo
    from bpnp.report.points import read_points

    names = problems or []
    if output is not None and len(names) > 1:
        raise ValueError(f"--output takes one problem, and {len(names)} are given; leave out --output")
    if (photo is None) != (camera is None):
        raise ValueError("a photo is drawn with its camera; give --photo and --camera together")
    if not run.exists():
        raise ValueError(f"{run} does not exist; give the folder of a test or the JSON of a solution")
    is_solution = not run.is_dir()
    if is_solution and names:
        raise ValueError(f"{run} is one solution, which has no problem {names[0]!r}")
    if photos is not None and (photo is not None or is_solution):
        raise ValueError("--photos finds the photos of a test; leave out --photo and --camera")
    check_outputs([output], [run, photo])
    source = None
    if is_solution:
        drawn, folder = [_solution(run)], run.absolute().parent
        file_names = {0: run.stem}
    else:
        folders = _runs_in([run])
        first = next(iter(folders.values()))
        folder = first if len(folders) == 1 else run
        tested = read_points(first)
        drawn, file_names = choose_problems(tested, names, first), picture_names(tested)
        if len(folders) > 1:
            drawn = merge_estimates(drawn, folders)
        if photos is not None:
            from bpnp.commands.photo_files import photo_finder
            from bpnp.report.results import read_results

            source = photo_finder(photos, side=VIEW_SIDE)(read_results(first), drawn)
    for problem in drawn:
        estimates = None if estimate is None else [estimate]
        if source is not None:
            found = source(problem)
            if found is None:
                raise ValueError(f"{photos} has no photo of {problem.id}")
            figure = plot_photo(replace(problem, camera=found.camera), found.pixels, estimates=estimates)
        elif photo is None or camera is None:
            figure = plot_problem(problem, estimate=estimate, lines=LINES[lines])
        else:
            with_camera = replace(problem, camera=_camera_of(camera, photo))
            figure = plot_photo(with_camera, read_photo(photo), estimates=estimates)
        say(f"wrote {save_figure(figure, output or folder / 'views' / f'{file_names[problem.index]}.png')}")


def merge_estimates(problems: "Sequence[ProblemPoints]", folders: Mapping[str, Path]) -> "list[ProblemPoints]":
    """Return problems with the poses of several tests, by the names of the tests and estimates.

    Results of other problems than those of the first test are left out.
    """
    from bpnp.report.points import read_points

    tests = {name: {problem.id: problem for problem in read_points(folder)} for name, folder in folders.items()}
    merged = []
    for problem in problems:
        estimates = {}
        for name, known in tests.items():
            other = known.get(problem.id)
            if other is None or other.points3d.tobytes() != problem.points3d.tobytes():
                continue
            for estimate, pose in other.estimates.items():
                estimates[name if len(other.estimates) == 1 else f"{name}: {estimate}"] = pose
        merged.append(replace(problem, estimates=estimates))
    return merged


def _camera_of(text: str, photo: Path) -> "Camera":
    """Return the camera of a photo, as `--camera` names it."""
    from bpnp.cameras import CENTRE, camera_from
    from bpnp.commands.point_files import COLMAP_CAMERAS, read_camera

    of_model = Path(text).is_dir() or Path(text).name in COLMAP_CAMERAS
    return camera_from(read_camera(text, photo.name if of_model else None, centre=CENTRE))


def _solution(path: Path) -> "ProblemPoints":
    """Return the points of a solution's file; a ValueError names the file."""
    from bpnp.report.solutions import solution_points
    from bpnp.search.solution import Solution

    content = read_bytes(path)
    try:
        return solution_points(Solution.from_json(content), title=path.stem)
    except ValueError as error:
        pictures = path.parent / "pictures"
        there = f"; the pictures of `bpnp localize` are in {pictures}" if pictures.is_dir() else ""
        raise ValueError(f"{path}: {error}{there}") from error


def picture_names(problems: "Sequence[ProblemPoints]") -> dict[int, str]:
    """Return a file name without suffix for each problem of a test, by its index.

    It is the name of the problem with underscores for what a file name cannot hold, and with the index if several
    problems would have the same file name.
    """
    plain = {problem.index: re.sub(r"[^\w.-]+", "_", problem.id) for problem in problems}
    counts = Counter(plain.values())
    return {index: name if counts[name] == 1 and name else f"{name}-{index}" for index, name in plain.items()}


def choose_problems(problems: "Sequence[ProblemPoints]", names: Sequence[str], folder: Path) -> "list[ProblemPoints]":
    """Return the problems with these names, or parts of names; without names, the worst problem.

    Raise ValueError if there are no problems, or a name is that of no problem, or part of several names.
    """
    if not problems:
        raise ValueError(f"{folder} has no points.npz; run `bpnp test` again, which writes it")
    if not names:
        return [max(problems, key=lambda problem: problem.error)]
    by_name = {problem.id: problem for problem in problems}
    chosen = []
    for name in names:
        alike = [id for id in by_name if id == name] or [id for id in by_name if name in id]
        if len(alike) != 1:
            some = ", ".join((alike or list(by_name))[:20])
            count = f"{len(alike)} problems" if alike else "no problem"
            raise ValueError(f"{name!r} is in the names of {count} in {folder}; give one of {some}")
        chosen.append(by_name[alike[0]])
    return chosen


def wandb_results(
    runs: list[Path], *, project: str = "bpnp", directory: Path | None = None, photos: Path | None = None
) -> None:
    """Log results to Weights & Biases: to folders for `wandb sync` unless WANDB_MODE=online.

    Args:
        runs: folders that `bpnp test` wrote, or their runs; differences are to the first.
        project: name of the project.
        directory: parent of the folders of offline runs; that of the results by default.
        photos: folder of the photos of COLMAP models, under their points; `images` of each scene by default.
    """
    from bpnp.commands.photo_files import photo_finder
    from bpnp.report.charts import import_plotly
    from bpnp.report.dashboards import log_results

    import_plotly()  # missing, it is named before anything is logged
    finder, named = photo_finder(photos, side=VIEW_SIDE), _runs_in(runs)
    first = next(iter(named.values()))
    for name, folder in named.items():
        written = log_results(
            folder, project=project, name=name, directory=directory, photos=finder, compare_with=first
        )
        say(f"logged {name} to {written}")


def table(
    *,
    data: str,
    methods: list[str],
    limit: int | None = None,
    rho: list[float] | None = None,
    seeds: list[int] | None = None,
    time_limit: float | None = None,
    output: Path = Path("runs/table"),
    paper: Literal["auto", "modelnet40", "megadepth", "none"] = "auto",
    overrides: list[str] | None = None,
) -> None:
    """Test several methods on the same problems and print the paper's table.

    Each method has a folder of results, as of `bpnp test`. A second run skips the methods that are finished.
    `--data.NAME=VALUE` overrides the data of the configuration.

    Args:
        data: name or file of a configuration with `data`.
        methods: [LABEL=]METHOD[@CHECKPOINT]; METHOD is softposit, ransac, gosma, gopac, hungarian, bpnpnet, matcher,
            search, a class path, or a .yaml file with model.solver. bpnpnet, matcher and hungarian are untrained
            without a CHECKPOINT (a file, or the name of packaged weights).
        limit: number of problems, a fixed random choice; all by default.
        rho: ratios of outliers to matches, on both sides; a table and a plot over these.
        seeds: seeds of the data; the table has the mean over these and its standard deviation.
        time_limit: seconds for each problem, for methods that have a limit; inf for no limit.
        output: folder of the results.
        paper: published rows to add.
    """
    from bpnp.datamodules import Outliers
    from bpnp.report.figure_files import save_figure
    from bpnp.report.figures import outlier_curves
    from bpnp.report.tables import (
        CAPTION,
        FILE_COLUMNS,
        PAPERS,
        as_latex,
        note,
        paper_rows,
        table_frame,
        table_of_rows,
    )  # fmt: skip
    from bpnp.search.arguments import positive
    from bpnp.training.comparison import MethodTest, parse_methods, read_data

    at_least(1, limit=limit)
    at_least(0, rho=min(rho, default=None) if rho else None)
    positive("time_limit", time_limit)
    chosen = parse_methods(methods, time_limit=time_limit)
    recipe = Path(packaged_config(data))
    tests: dict[tuple[float | None, str], list[MethodTest]] = {}  # by outlier ratio and method, one for each seed
    ratios: list[float | None] = [*dict.fromkeys(rho)] if rho else [None]
    data_seeds: list[int | None] = [*dict.fromkeys(seeds)] if seeds else [None]
    for ratio, seed in product(ratios, data_seeds):
        changes, folder = list(overrides or []), output
        if ratio is not None:
            outliers = json.dumps(asdict(Outliers(ratio)))
            changes, folder = [*changes, f"--data.test_outliers={outliers}"], folder / f"rho-{ratio:g}"
        if seed is not None:
            changes, folder = [*changes, f"--data.seed={seed}"], folder / f"seed-{seed}"
        data_settings = read_data(recipe, changes)
        for method in chosen:
            test = MethodTest(method, data_settings, folder / method.folder_name, limit)
            tests.setdefault((ratio, method.label), []).append(test)
    every = [test for several in tests.values() for test in several]
    out = console()
    with ExitStack() as held:
        for test in every:
            held.enter_context(lock_folder(test.folder))
        missing = [test for test in every if test.results() is None]
        if len(missing) < len(every):
            say(f"{len(every) - len(missing)} of {len(every)} tests are finished, in {output}", to=out)
        for test in missing:
            say(f"testing {test.method.label} in {test.folder}", to=out)
            test.run(progress_bar=out.is_interactive)
        rows = [row for (ratio, label), repeated in tests.items() for row in _rows(label, ratio, repeated)]
    published = PAPERS.get(data_settings["class_path"].rpartition(".")[2]) if paper == "auto" else paper
    rows += paper_rows(None if published == "none" else published)
    out.print(table_of_rows("Pose errors", FILE_COLUMNS, rows, " ".join([CAPTION, *note(rows)])))
    frame = table_frame(rows)
    for name, text in {"table.csv": frame.to_csv(index=False), "table.tex": as_latex(rows)}.items():
        say(f"wrote {write_text(output / name, text)}", to=out)
    if rho is not None:
        say(f"wrote {save_figure(outlier_curves(frame), output / 'outliers.png')}", to=out)


def _rows(label: str, ratio: float | None, tests: "list[MethodTest]") -> "list[MethodRow]":
    """Return a row per estimate of a method; for several seeds, their mean and standard deviation."""
    from pandas import DataFrame

    from bpnp.report.tables import MethodRow

    results = [result for test in tests if (result := test.results()) is not None]
    count = {"problems": sum(result.problems for result in results)}
    rows = []
    for estimate in results[0].estimates:
        name = f"{label} {estimate}" if len(results[0].estimates) > 1 else label
        frame = DataFrame([result.estimates[estimate] for result in results])
        mean: dict[str, Any] = frame.mean(skipna=False).to_dict()
        rows.append(MethodRow(name, mean | count, rho=ratio, problems=("rho", ratio)))
        if len(results) > 1:
            deviation = frame.std(skipna=False).to_dict()
            rows.append(MethodRow(f"{name}, standard deviation of {len(results)} seeds", deviation | count, rho=ratio))
    return rows
