"""The short help of `bpnp fit`, `validate` and `test`: what most runs need, without importing Lightning."""

LIGHTNING = {
    "fit": "Train a solver.",
    "validate": "Evaluate a solver on the validation pairs.",
    "test": "Evaluate a solver on the test pairs and write their results.",
}
# What `bpnp fit --help GROUP` shows: the options that begin with these.
GROUPS = {
    "model": ("model", "optimizer", "lr_scheduler"),
    "data": ("data",),
    "trainer": ("trainer",),
    "files": ("best_checkpoint", "last_checkpoint", "results"),
    "all": ("",),
}
OPTIONS = {
    "--config NAME": "packaged configuration or a YAML file; of several, later ones override",
    "--ckpt_path FILE": "checkpoint, `last`, or the name of packaged weights",
    "--print_config": "print all options with their values, to use as --config",
    "--seed_everything N": "seed",
    "--data CLASS": "class path of the data, such as bpnp.datamodules.MeshDataModule",
    "--data.root FOLDER": "where they are; procedural shapes without it",
    "--data.num_points N": "points a pair",
    "--data.batch_size N": "pairs a step",
    "--model CLASS": "class path of a LightningModule in place of BlindPnPTask",
    "--model.solver CLASS": "class path of an nn.Module from Batch to Prediction",
    "--model.weights NAME": "start from packaged weights, or from a checkpoint",
    "--model.loss CLASS": "class path of a loss in place of --model.matching_loss",
    "--model.matching_loss KIND": "correspondence (the paper's), likelihood, or reprojection",
    "--model.learning_rate X": "of Adam",
    "--trainer.default_root_dir FOLDER": "folder of the run: checkpoints, logs, results",
    "--trainer.max_epochs N": "epochs",
    "--trainer.max_time DD:HH:MM:SS": "time limit",
    "--trainer.accelerator NAME": "cpu, gpu or auto",
    "--trainer.fast_dev_run true": "one batch of each stage, nothing is written",
}
COLUMN = 36


def short_help(command: str) -> str:
    """What `bpnp COMMAND --help` shows, for a command of `LIGHTNING`."""
    options = [f"  {option:<{COLUMN}}{text}" for option, text in OPTIONS.items()]
    return "\n".join(
        [
            f"usage: bpnp {command} --config NAME [options]",
            "",
            LIGHTNING[command],
            "",
            *options,
            "",
            f"bpnp {command} --help GROUP lists every option of a group: {', '.join(GROUPS)}.",
            f"bpnp {command} --data.help=CLASS, --model.solver.help=CLASS and so on those of a class.",
        ]
    )


def group_asked_for(arguments: list[str]) -> str | None:
    """The group in `fit --help GROUP`: "" without one, None where no help is asked for.

    Raises ValueError for another word that is no option.
    """
    found = next((i for i, text in enumerate(arguments) if text in ("-h", "--help")), None)
    if found is None:
        return None
    following = arguments[found + 1 : found + 2]
    if following and following[0].startswith("-"):
        return ""
    if following and following[0] not in GROUPS:
        raise ValueError(f"expected --help, or --help and one of {', '.join(GROUPS)}, got {following[0]!r}")
    return following[0] if following else ""
