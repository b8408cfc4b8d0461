"""`bpnp localize`: images of a COLMAP model, solved as if nobody knew where they were taken."""

from functools import partial
from pathlib import Path
from typing import Literal

from bpnp.commands.output import console
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.files import claimed
from bpnp.localization.from_models import draw_image, image_source, localize_image, model_photos, write_localized
from bpnp.localization.localized import Localized, localized_table, summary
from bpnp.localization.slow_progress import SlowProgress


def localize(
    *,
    model: Path,
    image: str = "all",
    points: Literal["seen", "clutter", "all"] = "seen",
    clutter: float = 0.25,
    output: Path = Path("runs/localize"),
    no_pictures: bool = False,
    solver: str = "search",
    inlier_threshold: float | None = None,
    time_limit: float | None = None,
    seed: int = 0,
    device: str | None = None,
) -> None:
    """Solve images of a COLMAP model as if their poses were unknown, and compare with the model's.

    The scene is turned at random, so that nothing of a pose leaks into its search. Writes results.json, images.txt
    (confident poses in the frame of the model) and pictures/<image>.png as it goes: an interruption loses nothing.

    Args:
        model: COLMAP model, such as sparse/0.
        image: one image, or all.
        points: which 2D and 3D points to solve; "seen", the keypoints with a 3D point and these; "clutter", with
            --clutter of the others on both sides; "all", every keypoint and every 3D point.
        clutter: ratio to the true pairs.
        output: folder of the results.
        no_pictures: write no pictures.
        solver: search, or the checkpoint of a BPnPNet.
        inlier_threshold: largest error of a match, pixels.
        time_limit: seconds a pair.
        seed: of the rotation and of the search.
        device: such as cuda; cpu by default.
    """
    source = image_source(read_reconstruction(model), image, points, clutter, seed)
    draw = None if no_pictures else partial(draw_image, *model_photos(model))
    done: list[Localized] = []
    with claimed(output), SlowProgress("localizing", total=len(source.images)) as progress:
        for index, (_, own) in enumerate(source.images):
            progress.describe(own.name)
            solution, result = localize_image(
                source, index, solver=solver, inlier_threshold=inlier_threshold, seed=seed, time_limit=time_limit,
                device=device,
            )  # fmt: skip
            done.append(result)
            write_localized(output, done, {"model": str(model), "points": points, "seed": seed})
            if draw is not None:
                draw(solution, result, output / "pictures")
            progress.advance()
    out = console()
    out.print(localized_table(done))
    out.print(summary(done), highlight=False, soft_wrap=True)
    written = ", ".join(["results.json", "images.txt", *([] if draw is None else ["pictures/"])])
    out.print(f"wrote {written} in {output}", markup=False, highlight=False, soft_wrap=True)
