"""Planted problems as `hypothesis` draws them: numbers of points, noise and outliers of either side."""

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from planted import Planted, plant

FEW = settings(  # examples cost a search: the first that fails is shown without shrinking
    max_examples=5,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@st.composite
def problems(
    draw: st.DrawFn, *, size: int = 1, least: int = 12, most: int = 60, noise: float = 1e-3, outliers: float = 0.3
) -> Planted:
    """`size` problems of the same numbers of points; the outliers of a side are at most this share of the matches."""
    points = draw(st.integers(least, most))
    few = st.integers(0, int(outliers * points))
    return plant(
        size,
        points,
        seed=draw(st.integers(0, 10**6)),
        noise=draw(st.sampled_from([0.0, noise])),
        outliers2d=draw(few),
        outliers3d=draw(few),
    )
