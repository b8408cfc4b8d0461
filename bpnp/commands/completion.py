"""`bpnp completion`: what a shell needs to complete the commands and their options."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from bpnp.commands.parser import command_parser
from bpnp.commands.training_help import GROUPS, LIGHTNING, OPTIONS
from bpnp.files import config_names

Commands = Mapping[str, Callable[..., Any] | Mapping[str, Any]]
WEIGHTS = Path(__file__).parents[1] / "weights"
SCRIPT = """\
_bpnp() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD-1]}}" words=""
    if [ "$COMP_CWORD" -eq 1 ]; then
        COMPREPLY=($(compgen -W "{commands}" -- "$word"))
        return
    fi
    case "$before" in
{values}
        *) case "${{COMP_WORDS[1]}} ${{COMP_WORDS[2]}}" in
{options}
        esac
        case "$word" in -*) ;; *) [[ "$words" = -* ]] && words="" ;; esac ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "$word") $(compgen -f -- "$word"))
}}
complete -o filenames -F _bpnp bpnp
"""


def completion_script(commands: Commands, shell: str) -> str:
    """The script that completes commands and options, for bash, or for zsh by way of bash's."""
    weights = " ".join(sorted(file.stem for file in WEIGHTS.glob("*.ckpt")))
    known = {"--config": " ".join(config_names()), "-c": " ".join(config_names()), "--ckpt_path": f"{weights} last"}
    known |= {"--prior": f"{weights} learned", "--solver": f"{weights} auto search", "--help": " ".join(GROUPS)}
    options = dict(_options(commands)) | {
        name: " ".join(dict.fromkeys(option.split()[0] for option in OPTIONS)) for name in LIGHTNING
    }
    script = SCRIPT.format(
        values="\n".join(f'        {name}) words="{values}" ;;' for name, values in known.items()),
        options="\n".join(f'            "{name}"*) words="{words}" ;;' for name, words in options.items()),
        commands=" ".join([*commands, *LIGHTNING]),
    )
    return ("autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else "") + script


def _options(commands: Commands) -> Iterator[tuple[str, str]]:
    """The options of each command, or the words after it."""
    for name, command in commands.items():
        if isinstance(command, Mapping):
            yield from ((f"{name} {word}", own) for word, own in _options(command))
            yield name, " ".join(command)
        else:
            parser = command_parser(name, command)
            names = [option for action in parser._actions for option in action.option_strings]
            yield name, " ".join(option for option in names if option.startswith("--") and option != "--print_shtab")
