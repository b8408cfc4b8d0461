"""Maps of a folder of photos, each built without one of them: features and matches once, then a reconstruction per
photo.

SIFT (the largest features of each photo) and exhaustive matching by pycolmap, one thread, one known camera. Kept for
the next run: features.db, full/sparse and without-<photo>/sparse.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from record import Similarity
from scipy.spatial.transform import Rotation

from bpnp import SceneMap


@dataclass(frozen=True)
class PhotoScene:
    """Photos of a folder, one camera for all (COLMAP's PINHOLE: fx, fy, cx, cy), and the folder of their maps.

    `features` is the largest number of features per photo; COLMAP keeps the largest ones.
    """

    photos: Path
    kept: Path
    camera: tuple[float, float, float, float]
    features: int

    @property
    def database(self) -> Path:
        """Path of the features and verified matches of all photos, which are computed at the first use."""
        path = self.kept / "features.db"
        if not path.is_file():
            self.kept.mkdir(parents=True, exist_ok=True)
            temporary = path.with_suffix(".part")
            temporary.unlink(missing_ok=True)
            reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
            reader.camera_model, reader.camera_params = "PINHOLE", ",".join(map(str, self.camera))
            extraction.num_threads, extraction.sift.max_num_features = 1, self.features
            pycolmap.extract_features(
                temporary, self.photos, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
                extraction_options=extraction,
            )  # fmt: skip
            matching = pycolmap.FeatureMatchingOptions()
            matching.num_threads = 1
            pycolmap.match_exhaustive(temporary, matching_options=matching)
            temporary.rename(path)
        return path

    def names(self) -> list[str]:
        """Return the names of the photos, sorted."""
        return sorted(path.name for path in self.photos.iterdir() if path.suffix.lower() in {".jpg", ".png"})

    def model(self, left_out: str | None = None) -> Path:
        """Return the model of all photos, or of all but one."""
        names = [name for name in self.names() if name != left_out]
        folder = self.kept / (f"without-{left_out}" if left_out else "full") / "sparse"
        if not folder.is_dir():
            options = pycolmap.IncrementalPipelineOptions()
            options.num_threads, options.random_seed, options.image_names = 1, 0, names
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            temporary = folder.with_name("part")
            shutil.rmtree(temporary, ignore_errors=True)
            temporary.mkdir(parents=True)
            models = pycolmap.incremental_mapping(self.database, self.photos, temporary, options)
            if not models:
                raise ValueError(f"no model was reconstructed from the {len(names)} photos of {self.photos}")
            largest = max(models, key=lambda number: models[number].num_reg_images())
            (temporary / str(largest)).rename(folder)
            shutil.rmtree(temporary)
        return folder


def align(here: SceneMap, there: SceneMap) -> Similarity:
    """Return the frame of `there` in that of `here`, from the poses of the views that both have: the mean rotation
    between their cameras, then their centres.
    """
    names = [view.name for view in here.views if view.name in there.view_numbers]
    ours, theirs = here.named(names), there.named(names)
    rotations = [b.rotation.T @ a.rotation for a, b in zip(ours, theirs, strict=True)]
    rotation = Rotation.from_matrix(np.array(rotations)).mean().as_matrix()
    a, b = (np.array([view.centre for view in views]) for views in (ours, theirs))
    a0, b0 = a - a.mean(0), b - b.mean(0)
    scale = float(((a0 @ rotation.T) * b0).sum() / (a0**2).sum())
    return Similarity(scale, rotation, b.mean(0) - scale * rotation @ a.mean(0))
