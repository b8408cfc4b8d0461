"""What the metrics over pairs share: numbers of every pair, over batches and processes, each pair counted once."""

import math
import warnings
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat

NO_PAIR = "expected at least one pair, got none; try update() before compute()"


class PairMetric(Metric):
    """Numbers of every pair, `width` of them, over batches and processes; each pair once, by its index."""

    full_state_update = False
    is_differentiable = False
    width: int
    records: list[Tensor]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("records", default=[], dist_reduce_fx="cat")

    def sync(self, *args: Any, **kwargs: Any) -> None:
        """A process without a batch joins the exchange with no rows, in the type and width of the others' rows."""
        if len(self.records) == 0:
            self.records.append(torch.empty(0, self.width + 1, dtype=torch.float64, device=self.device))
        super().sync(*args, **kwargs)

    def _append(self, *columns: Tensor, index: Tensor | None) -> None:
        """Add rows; those without an index are all counted."""
        index = torch.full_like(columns[0], math.nan) if index is None else index
        self.records.append(torch.stack([column.detach().double() for column in (*columns, index)], -1))

    def _columns(self) -> tuple[Tensor, ...]:
        """The columns so far, with the first occurrence of each pair."""
        records = dim_zero_cat(self.records)
        if len(records) == 0:
            raise ValueError(NO_PAIR)
        values, index = records[:, :-1], records[:, -1]
        order = torch.argsort(index, stable=True)
        again = index[order].diff() == 0  # never true of NaN, the index of pairs that have none
        first, repeat = order[:-1][again], order[1:][again]
        if not torch.isclose(values[first], values[repeat], rtol=1e-3, atol=1e-3, equal_nan=True).all():
            message = "expected one pair per `Batch.index`, got one index with several values; the first is counted"
            warnings.warn(f"{message}; try a metric per data set, and an index for each of its pairs", stacklevel=2)
        keep = torch.ones_like(index, dtype=torch.bool)
        keep[repeat] = False
        return values[keep].unbind(-1)


class MeanOverPairs(PairMetric):
    """Mean of one value per pair over batches and processes, each pair counted once by its `Batch.index`.

    >>> mean = MeanOverPairs()
    >>> mean.update(torch.tensor([1.0, 2.0, 6.0]), torch.tensor([0, 1, 2]))
    >>> mean.update(torch.tensor([6.0]), torch.tensor([2]))
    >>> float(mean.compute())
    3.0
    """

    higher_is_better = False
    width = 1

    def update(self, values: Float[Tensor, " b"], index: Int[Tensor, " b"]) -> None:
        self._append(values, index=index)

    def compute(self) -> Float[Tensor, ""]:
        return self._columns()[0].mean()
