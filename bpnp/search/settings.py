"""What varies from search to search: the iterations, the expected outliers, and the searches near a prior."""

from dataclasses import dataclass, replace

MOST_ITERATIONS = 400  # largest number of iterations of a search [iterations; convention]
OUTLIERS = 0.3  # outlier fraction of the annealing if the caller gives none [fraction; calibration]
END_OUTLIERS = (0.03, 0.6)  # other outlier fractions of the last stage; the likelihood chooses [fractions; calibration]
# Without it, a single outlier would be forced into a match.
LEAST_OUTLIERS = 0.02  # least outlier fraction [fraction; convention]


@dataclass(frozen=True)
class Draws:
    """Number of initial poses around a rough pose."""

    # For a prior with the standard deviations `wide_deg`, `wide_shift` and `wide_across`, or larger ones. These leave
    # few gaps over the width of a basin. A narrower prior gets fewer, at the same density.
    starts: int = 2**16  # number of initial poses [poses; calibration]
    wide_deg: float = 12.0  # standard deviation of the rotation [degrees; calibration]
    # Standard deviation of the translation along the view, as a fraction of the distance.
    wide_shift: float = 0.12  # [fraction; calibration]
    least_starts: int = 2**14  # least number of initial poses [poses; calibration]
    # Standard deviation of the translation across the view: that of `wide_shift` where the RMS angular radius of the
    # bearings is 0.3. Basins shrink with the view in these directions.
    wide_across: float = 0.4  # [RMS angular radii; derived]
    # Largest distance of the centroid of the points from the centre of the view, in RMS angular radii of the bearings
    # and the points. In 13 of 14 calibration photos it was at most 0.83 of the former.
    reach: float = 0.7  # [RMS angular radii; calibration]


@dataclass(frozen=True)
class Preselection:
    """Preselection of initial poses on the density map, in steps."""

    points: tuple[int, ...] = (300, 5000)  # number of 3D points that each step scores [points; calibration]
    kept: tuple[int, ...] = (2**13, 2**10)  # number of poses that each step keeps [poses; calibration]


@dataclass(frozen=True)
class Narrowing:
    """Sequence of scales from the preselection to the annealing."""

    # Smoothing of the bearings at the first step. From 0.12 on, chance fills the view. At 0.03, the gaps between the
    # initial poses are wider than the basins.
    first_scale: float = 0.06  # [RMS angular radii; calibration]
    last_scale: float = 0.011  # smoothing at the last step [RMS angular radii; calibration]
    # Below a factor of 0.7 from step to step, the narrower optimum is lost more often.
    steps: int = 5  # number of steps; 0 for the first scale alone [steps; calibration]
    copies: int = 16  # number of copies of each pose at each step [poses; calibration]
    points: int = 1500  # number of 3D points that each step scores [points; calibration]


@dataclass(frozen=True)
class DensityShape:
    """Density map of the view."""

    background: float = 8.0  # standard deviation of the background density [scales; calibration]
    cells: float = 2.0  # number of cells per scale [cells; calibration]
    most_cells: int = 1024  # largest number of cells per side [cells; cost]
    # Outlier fraction of the map; also the least outlier fraction of the annealing that follows.
    outliers: float = 0.85  # [fraction; calibration]
    # Fraction of the largest background density below which a cell is outside the view.
    inside: float = 0.05  # [fraction; calibration]


@dataclass(frozen=True)
class DensitySearch:
    """One density-map search (`bpnp.search.propose.density_map`): draw, preselect, narrow, anneal."""

    draws: Draws = Draws()
    preselection: Preselection = Preselection()
    narrowing: Narrowing = Narrowing()
    density_map: DensityShape = DensityShape()
    annealed: int = 40  # number of poses that are annealed at the end [poses; calibration]


NEAR = tuple(  # [`DensitySearch`; chosen on photos of south_building, which docs/measured.md reports too]
    DensitySearch(preselection=Preselection((100, 1000), kept), narrowing=Narrowing(first, points=600), annealed=12)
    # The finer one is for dense keypoints and few visible points; in its narrower basins, ranks are less certain.
    for first, kept in ((0.06, (2**13, 2**10)), (0.03, (2**13, 2**11)))
)


@dataclass(frozen=True)
class SearchSettings:
    """Settings of one search; docs/search.md describes the stages."""

    iterations: int = MOST_ITERATIONS  # at most
    outliers: float = OUTLIERS  # expected fraction of points without a correspondence
    end_outliers: tuple[float, ...] = END_OUTLIERS  # other fractions of the last stage
    near: tuple[DensitySearch, ...] = NEAR  # searches around a prior

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"`iterations` is {self.iterations}; at least 1 is needed")
        if not all(0 < share < 1 for share in (self.outliers, *self.end_outliers)):
            raise ValueError(
                f"`outliers` is {self.outliers} and `end_outliers` {self.end_outliers}; all must be between 0 and 1"
            )

    def limited(self, iterations: int) -> "SearchSettings":
        """Return a copy of these settings with at most this number of iterations."""
        return replace(self, iterations=iterations)

    def expecting(self, clutter: float) -> "SearchSettings":
        """Return a copy whose stages all use a given outlier fraction, in [0, 1); the last stage tries no other."""
        if not 0 <= clutter < 1:
            raise ValueError(f"`clutter` is {clutter}; it is a fraction of the points, 0 or more and below 1")
        return replace(self, outliers=max(clutter, LEAST_OUTLIERS), end_outliers=())


DEFAULT = SearchSettings()
