"""`bpnp verify MAP`: verify the pose of each image of a COLMAP model."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from bpnp.files import check_outputs, write_text
from bpnp.report.terminal import VERDICTS, WIDTH, SplitTable, console, count_items, say, shorten

if TYPE_CHECKING:
    from bpnp.maps.verified_map import VerifiedView

COLUMNS = ("verdict", "points", "matches", "error\npx", "log10\nNFA", "change\ndeg")
CAPTION = (
    "points: points in view that two other images observe. matches: keypoints near one of them. error: mean error of "
    "the matches. log10 NFA: log10 of the number of false alarms. change: from the pose to the optimum of these points."
)
SUFFIXES = (".json", ".csv")
NAME_WIDTH = WIDTH // 3  # width of an image's name, columns
REASONS = 20  # largest number of images that are not confident whose reason is printed


def verify_images(
    map: Path,
    *,
    output: Path | None,
    page: Path | None,
    json: bool,
    quiet: bool = False,
    time_limit: float | None,
    seed: int,
) -> list[str]:
    """Verify each image of a COLMAP model, print a row for each, and return the verdicts.

    The arguments are those of `bpnp verify`.
    """
    from bpnp.datamodules.colmap.model_files import model_format

    if not map.is_dir():
        what = "is a file" if map.exists() else "does not exist"
        raise ValueError(
            f"{map} {what}; name points2d, points3d and a pose, or the folder of a COLMAP model such as sparse/0"
        )
    for option, path, suffixes in (("--output", output, SUFFIXES), ("--page", page, (".html",))):
        if path is not None and path.suffix.lower() not in suffixes:
            raise ValueError(f"{option} is {path}; name a file that ends in {' or '.join(suffixes)}")
    if not model_format(map) and (inside := [path for path in sorted(map.glob("*")) if model_format(path)]):
        raise ValueError(f"{map} has no COLMAP model, but {inside[0]} has; try bpnp verify {inside[0]}")

    from bpnp.maps.scene_map import SceneMap
    from bpnp.maps.verified_map import as_csv, as_json, page_html, summary, verify_map
    from bpnp.search.arguments import seconds_from
    from bpnp.search.solvers import TIME_LIMIT

    limit = seconds_from(time_limit, TIME_LIMIT)
    scene = SceneMap.from_colmap(map)
    check_outputs([output, page])
    with count_items("verifying", len(scene.views), quiet=quiet) as done:
        verified = verify_map(map, scene, seed=seed, time_limit=limit, done=done)
    out = console(json=json, quiet=quiet)
    if json:
        say(as_json(verified, map))
    else:
        out.print(_table(verified))
        doubtful = [one for one in verified if one.doubtful]
        for one in doubtful[:REASONS]:
            say(f"{one.name}: {one.reason}", to=out)
        if len(doubtful) > REASONS:
            say(f"... and {len(doubtful) - REASONS} more, whose reasons --output, --page and --json give", to=out)
        say(summary(verified), to=out)
    if output is not None:
        text = as_csv(verified) if output.suffix.lower() == ".csv" else as_json(verified, map) + "\n"
        say(f"wrote {write_text(output, text, errors='surrogateescape')}", to=out)
    if page is not None:
        say(f"wrote {write_text(page, page_html(verified, scene, map))}", to=out)
    return [one.verdict for one in verified]


def _table(verified: "Sequence[VerifiedView]") -> Any:
    """Return a table with a row for each image."""
    from bpnp.maps.verified_map import UNTESTED, cells

    styles = VERDICTS | {UNTESTED: "dim"}
    names = shorten([one.name for one in verified], NAME_WIDTH)
    rows = [
        (Text(name), [Text(one.verdict, styles[one.verdict]), *map(Text, cells(one))])
        for name, one in zip(names, verified, strict=True)
    ]
    return SplitTable("", COLUMNS, [rows], CAPTION)
