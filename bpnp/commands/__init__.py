"""Commands other than Lightning's: one typed function each, whose signature and docstring define its options."""

from collections.abc import Callable, Mapping

from bpnp.commands.localizing import localize
from bpnp.commands.preparing import convert_weights, prepare_authors, prepare_megadepth, prepare_modelnet40
from bpnp.commands.reporting import report, table, view, wandb_results
from bpnp.commands.solving import solve, verify, warm_up

Command = Callable[..., int | None]  # returns the exit status, None for 0

COMMANDS: Mapping[str, Command | Mapping[str, Command]] = {
    "solve": solve,
    "verify": verify,
    "localize": localize,
    "report": report,
    "view": view,
    "wandb": wandb_results,
    "table": table,
    "prepare": {"modelnet40": prepare_modelnet40, "megadepth": prepare_megadepth, "authors": prepare_authors},
    "convert-weights": convert_weights,
    "warm-up": warm_up,
}
