"""The commands beside Lightning's own: one typed function each, whose signature and docstring are its options."""

import sys
from collections.abc import Callable, Mapping
from typing import Literal

from bpnp.commands.completion import completion_script
from bpnp.commands.localizing import localize
from bpnp.commands.preparing import prepare_megadepth, prepare_modelnet40, prepare_released
from bpnp.commands.reporting import report, view, wandb_results
from bpnp.commands.solving import solve
from bpnp.commands.tables import table
from bpnp.commands.weights import convert_weights

Command = Callable[..., None]


def completion(shell: Literal["bash", "zsh"] = "bash") -> None:
    """Print the completion of commands and options for a shell.

    For bash put `eval "$(bpnp completion bash)"` into ~/.bashrc, for zsh `eval "$(bpnp completion zsh)"` into ~/.zshrc.

    Args:
        shell: bash or zsh.
    """
    sys.stdout.write(completion_script(COMMANDS, shell))


COMMANDS: Mapping[str, Command | Mapping[str, Command]] = {
    "solve": solve,
    "localize": localize,
    "report": report,
    "view": view,
    "wandb": wandb_results,
    "table": table,
    "prepare": {
        "modelnet40": prepare_modelnet40,
        "megadepth": prepare_megadepth,
        "preprocessed": prepare_released,
    },
    "convert-weights": convert_weights,
    "completion": completion,
}
