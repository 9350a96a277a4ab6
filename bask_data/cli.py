"""The command line: a command per stage, an `ingest` sub-command per format, and the dataset's commands. No logic."""

from __future__ import annotations

import functools
import inspect
import json
import os
import shlex
import signal
import sys
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import typer

from bask_data import __version__
from bask_data.config import load_config
from bask_data.console import say, show_error, show_outcome, shown_progress
from bask_data.dataset import DATASET, Dataset, Splits, Variant
from bask_data.errors import BaskError, MissingDependency, UsageError, imported
from bask_data.export import FormatName
from bask_data.formats import FORMATS, Format
from bask_data.params import Params, first_fault
from bask_data.pipeline import STAGES
from bask_data.presets import PRESETS, PresetName
from bask_data.sim.options import SimOptions, TaskName
from bask_data.stage import (
    Config,
    Outcome,
    Stage,
    State,
    follow,
    foretold,
    is_follower,
    plan,
    processes,
    run,
    state_told,
)

Root = Annotated[Path, typer.Argument(help="The dataset's directory.", metavar="ROOT")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
Only = Annotated[str, typer.Option(help="Only these scenes or demonstrations, separated by commas.", metavar="NAMES")]
Jobs = Annotated[int, typer.Option(min=1, help="Items worked on at the same time, each in a process of its own.")]
Cluster = Annotated[str, typer.Option(help="Dask scheduler to work on instead: tcp://host:8786.", metavar="ADDRESS")]
Force = Annotated[bool, typer.Option("--force", help="Make it again even if it is up to date.")]
ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="YAML: a section per stage, or `stage@name` for one item. [default: ROOT/params.yaml]",
        metavar="FILE",
    ),
]
Preset = Annotated[
    PresetName | None,
    typer.Option(
        "--preset",
        help="How networks are trained: tabletop is the default, bask the paper's way, bask-code that of its code, "
        "florence that of the Dense Object Nets before. Goes over the file.",
    ),
]
Set = Annotated[
    list[str],
    typer.Option("--set", help="One parameter: stage.field=value. May be repeated.", metavar="STAGE.FIELD=VALUE"),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be made, and why, and make nothing.")]
AFTER_DRY_RUN = "the same without --dry-run"

app = typer.Typer(
    name="bask-data",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="RGB-D scans in; object masks, dense correspondence and Bayesian scene keypoints out.\n\n"
    "A dataset is a directory: `ingest` fills it, `run` makes everything else from it, `status` says what is stale.",
)
ingest_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Read a recording into a dataset; one sub-command per format."
)
app.add_typer(ingest_app, name="ingest")
evaluate_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Hold what was made against the truth of recordings that have one.",
)
app.add_typer(evaluate_app, name="evaluate")


def main() -> None:
    """Run the command line and leave with the documented exit code."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    app()


def _reporting(body: Callable[..., None]) -> Callable[..., None]:
    """The same command, with errors as one line for a person and an exit code for a script."""

    @functools.wraps(body)
    def command(*args: Any, **kwargs: Any) -> None:
        try:
            body(*args, **kwargs)
        except (typer.Exit, typer.Abort):
            raise
        except KeyboardInterrupt:
            say("interrupted: what was finished is kept; the same command goes on from there.")
            raise typer.Exit(130) from None
        except BrokenProcessPool:
            say("error: a worker process was killed.  fix: it may have run out of memory; use fewer --jobs.")
            raise typer.Exit(1) from None
        except BrokenPipeError:
            # Whoever read our output has gone: point it at nothing, or the interpreter complains when it closes it.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except BaskError as error:
            show_error(error)
            raise typer.Exit(error.exit_code) from None
        except ImportError as error:
            show_error(
                MissingDependency(
                    "import", error.name or "", expected="a package that loads", got=str(error), fix="bask-data doctor"
                )
            )
            raise typer.Exit(MissingDependency.exit_code) from None
        except Exception as error:
            if os.environ.get("BASK_DEBUG"):
                raise
            say(f"error: {type(error).__name__}: {error}  fix: set BASK_DEBUG=1 for the traceback.")
            raise typer.Exit(1) from None

    return command


@app.callback(invoke_without_command=True)
@_reporting
def _version(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    if version:
        print(f"bask-data {__version__}")
        raise typer.Exit
    able = [stage.name for stage in STAGES if stage.together]
    if processes() > 1 and context.invoked_subcommand not in able:
        raise UsageError("torchrun", "command", expected=" or ".join(able), got=context.invoked_subcommand)


# Options from models --------------------------------------------------------------------------------------------------


def _parameter(
    name: str, annotation: Any, default: Any, kind: Any = inspect.Parameter.KEYWORD_ONLY
) -> inspect.Parameter:
    return inspect.Parameter(name, kind, annotation=annotation, default=default)


def _option(name: str, field: Any) -> inspect.Parameter:
    """One field of a model as an option. Unset stays None, so that the configuration below it is seen."""
    flag = "--" + name.replace("_", "-")
    annotation = _plain_type(field.annotation)
    default = field.get_default(call_default_factory=True)
    shown = "" if default is None or default == "" or default is ... else _as_text(default)
    flags = [f"{flag}/--no-{flag[2:]}"] if annotation is bool else [flag]
    text = (field.description or "") + (f" [default: {shown}]" if shown else "")
    option = typer.Option(*flags, help=text, show_default=False)
    return _parameter(name, Annotated[annotation | None, option], None)


def _plain_type(annotation: Any) -> Any:
    """The type of an option; what is no number, flag or choice is text, and checked by the model."""
    if get_origin(annotation) is Literal:
        return annotation
    if get_origin(annotation) in (typing.Union, types.UnionType):
        inner = [part for part in get_args(annotation) if part is not type(None)]
        return _plain_type(inner[0]) if len(inner) == 1 else str
    return annotation if annotation in (bool, int, float) else str


def _as_text(value: Any) -> str:
    if isinstance(value, tuple | list):
        return ",".join(map(str, value))
    return str(value)


def _given(model: type[Params], options: dict[str, Any]) -> dict[str, Any]:
    """The options that were set, lists split at commas."""
    given = {name: value for name, value in options.items() if name in model.model_fields and value is not None}
    for name, value in given.items():
        annotation = model.model_fields[name].annotation
        if isinstance(value, str) and _is_sequence(annotation):
            given[name] = [part.strip() for part in value.split(",") if part.strip()]
    return given


def _is_sequence(annotation: Any) -> bool:
    if get_origin(annotation) in (tuple, list):
        return True
    return any(_is_sequence(part) for part in get_args(annotation))


def _command(
    target: typer.Typer,
    name: str,
    help: str,
    parameters: list[inspect.Parameter],
    body: Callable[..., None],
) -> None:
    """Add a command whose signature is made here: Typer reads options off signatures only."""

    def command(**arguments: Any) -> None:
        _reporting(body)(**arguments)

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    target.command(name, help=help)(command)


def _model_values(model: type[Params], options: dict[str, Any], where: str) -> Params:
    from pydantic import ValidationError

    try:
        return model.model_validate(_given(model, options))
    except ValidationError as error:
        field, expected, came = first_fault(error)
        option = "--" + field.split(".")[0].replace("_", "-")
        raise UsageError(where, option, expected=expected, got=came, fix=f"see `{where} --help`.") from error


# Stages ---------------------------------------------------------------------------------------------------------------


@contextmanager
def _executor(jobs: int, cluster: str) -> Iterator[Executor | None]:
    """Where items are worked on: here, in a pool of processes, or on a Dask cluster."""
    if cluster:
        with imported("distributed", "Dask", user="--cluster", extra="cluster").Client(cluster) as client:
            yield client.get_executor()
    elif jobs > 1:
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        # Open3D and torch keep threads: a forked child would inherit their locks.
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            try:
                yield pool
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    else:
        yield None


def _quoted(path: Path) -> str:
    """A path as it can be pasted into a shell."""
    return shlex.quote(str(path))


def _parameters(
    root: Path, config: Path | None, assignments: Sequence[str], preset: PresetName | None = None
) -> Config:
    """Of `--config`, or else of the dataset's own params.yaml, with `--preset` and then `--set` over them."""
    own = root / "params.yaml"
    return load_config(config or (own if own.exists() else None), assignments, STAGES, preset)


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _finish(command: str, outcomes: Sequence[Outcome], as_json: bool, next_command: str = "", **more: Any) -> None:
    """Print the sum and leave with the exit code of the first failure."""
    if as_json:
        rows = [
            {
                key: getattr(outcome, key)
                for key in ("label", "kind", "item", "variant", "path", "status", "why", "seconds", "digest")
            }
            | {"metadata": _attributes(outcome)}
            for outcome in outcomes
        ]
        print(json.dumps({"command": command, "outcomes": rows, **more}, indent=2))
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    blocked = [outcome for outcome in outcomes if outcome.status == "blocked"]
    if failed:
        say(f"{len(failed)} failed, {len(blocked)} blocked, {len(outcomes) - len(failed) - len(blocked)} fine.")
        raise typer.Exit(failed[0].error.exit_code if failed[0].error else 1)
    if blocked:
        fix = "make it first, or `bask-data run`."
        if any("has no scenes" in outcome.why for outcome in blocked):
            fix = "bask-data ingest FORMAT SOURCE ROOT --scene NAME --as scan"
        say(f"{len(blocked)} blocked: an input is missing.  fix: {fix}")
        raise typer.Exit(UsageError.exit_code)
    if next_command:
        say(f"next: {next_command}")


def _attributes(outcome: Outcome) -> dict[str, Any]:
    """What the artifact states of itself; empty where there is none."""
    if outcome.status not in ("made", "up to date") or not outcome.path:
        return {}
    from bask_data.artifact import Artifact

    return Artifact(outcome.path).attributes


def _show_findings(outcome: Outcome) -> None:
    """What a stage wants a person to know."""
    from bask_data.kinds import KINDS

    if outcome.status == "made":
        [kind] = [kind for kind in KINDS if kind.kind == outcome.kind]
        for line in kind(outcome.path).summary():
            say(f"              {line}")
    for warning in _attributes(outcome).get("warnings", []):
        say(f"  note: {outcome.label}: {warning}")


def _add_stage(stage: Stage) -> None:
    # Positional parameters first, as a signature wants them.
    parameters = [_parameter("root", Root, inspect.Parameter.empty)]
    if stage.makes.scope != "dataset":
        parameters.append(_parameter("only", Only, ""))
    if stage.makes.has_variants:
        option = typer.Option(
            "--variant", help="Name of this result, to keep several beside each other.", metavar="NAME"
        )
        parameters.append(_parameter("variant", Annotated[str, option], "main"))
        for given in stage.inputs:
            if given.artifact.has_variants:
                kind = given.artifact.kind
                option = typer.Option(
                    f"--{kind}", help=f"Variant of the {kind} to use. [default: that of --variant]", metavar="NAME"
                )
                parameters.append(_parameter(f"variant_of_{kind}", Annotated[str, option], ""))
    parameters += [_option(name, field) for name, field in stage.params.model_fields.items()]
    parameters += _pick_options() if stage.makes.kind == "reference" else []
    parameters += [
        _parameter("jobs", Jobs, 1),
        _parameter("cluster", Cluster, ""),
        _parameter("force", Force, False),
        _parameter("config", ConfigFile, None),
        *([_parameter("preset", Preset, None)] if stage.name in PRESETS["bask"] else []),
        _parameter("set_", Set, []),
        _parameter("dry_run", DryRun, False),
        _parameter("json_", Json, False),
        _parameter("stage_version", Annotated[int, typer.Option(hidden=True)], 0),
    ]

    def body(
        root: Path, config: Path | None, set_: list[str], dry_run: bool, json_: bool, force: bool, **options: Any
    ) -> None:
        if options["stage_version"] not in (0, stage.version):
            raise UsageError(
                stage.name,
                "--stage-version",
                expected=str(stage.version),
                got=options["stage_version"],
                fix=f"bask-data dvc {root}",
            )
        dataset = Dataset(root)
        if not is_follower():
            dataset.recover()
        variant = options.get("variant", "main")
        chosen = {
            name.removeprefix("variant_of_"): value
            for name, value in options.items()
            if name.startswith("variant_of_") and value
        }
        planned = functools.partial(
            plan,
            dataset,
            stage,
            config=_parameters(root, config, set_, options.get("preset")),
            only=_names(options.get("only", "")),
            variant=variant,
            variant_inputs=chosen,
        )
        given = _given(stage.params, options)
        tasks = planned(options=given)
        if not tasks:
            raise UsageError(
                root, "", expected=f"a {stage.makes.scope}", got="none in the dataset", fix="bask-data ingest --help"
            )
        if is_follower():
            for task in tasks if not dry_run else []:
                follow(task, force)
            return
        outcomes = []
        following = AFTER_DRY_RUN if dry_run else _following(stage, root, variant, chosen)
        if options.get("pick"):
            outcomes = _pick(
                dataset,
                planned=lambda new: planned(options={**given, **new})[0],
                parameters=config or root / "params.yaml",
                following=following,
                inputs=chosen,
                dry_run=dry_run,
                options=options,
            )
        else:
            _refuse_without_pick(options)
            with shown_progress(), _executor(options["jobs"], options["cluster"]) as executor:
                for outcome in foretold(tasks, set(), force) if dry_run else run(tasks, executor=executor, force=force):
                    show_outcome(outcome)
                    _show_findings(outcome)
                    outcomes.append(outcome)
        if variant != "main" and not dry_run and any(outcome.status == "made" for outcome in outcomes):
            dataset.add_variant(stage.makes, variant, Variant(inputs=chosen))
        saved_nothing = bool(options.get("pick")) and not outcomes
        _finish(stage.name, outcomes, json_, "" if saved_nothing else following)

    _command(app, stage.name, stage.help, parameters, body)


def _following(stage: Stage, root: Path, variant: str, chosen: dict[str, str]) -> str:
    """The command that goes on with what a stage has made, in the same variants."""
    later = [other for other in STAGES if stage.makes in [given.artifact for given in other.inputs]]
    if not later:
        return f"bask-data report {_quoted(root)}"
    own = {given.artifact.kind for given in stage.inputs if given.artifact.has_variants}
    shared = [given.artifact.kind for given in later[0].inputs if given.artifact.kind in own]
    variants = {stage.makes.kind: variant, **{kind: chosen.get(kind, variant) for kind in shared}}
    words = [f"--{kind} {name}" for kind, name in variants.items() if name != "main"]
    return " ".join([f"bask-data {later[0].name} {_quoted(root)}", *words])


def _pick_options() -> list[inspect.Parameter]:
    """Of `reference` alone: where its picks may come from besides the parameters."""
    flag = typer.Option("--pick", help="Choose them on a page in a browser, which shows where each would be found.")
    port = typer.Option(min=0, max=65535, help="With --pick: of the page. [default: any that is free]")
    browser = typer.Option("--browser/--no-browser", help="With --pick: open the page, where there is a display.")
    return [
        _parameter("pick", Annotated[bool, flag], False),
        _parameter("port", Annotated[int | None, port], None),
        _parameter("browser", Annotated[bool, browser], True),
    ]


def _refuse_without_pick(options: dict[str, Any]) -> None:
    if options.get("port") is not None:
        raise UsageError("reference", "--port", expected="to come with --pick", got="it alone", fix="--pick --port N")


def _pick(dataset: Dataset, *, dry_run: bool, options: dict[str, Any], **picking: Any) -> list[Outcome]:
    """What was saved on the page, when it is closed."""
    from bask_data.picker import Picking, pick_keypoints

    if dry_run:
        raise UsageError("reference", "--dry-run", expected="no --pick beside it", got="both")

    def opened(url: str) -> None:
        say(f"open {url}  (Ctrl-C ends it; unsaved keypoints are kept)")
        if options["browser"]:
            _open_in_browser(url)

    with shown_progress():
        found = Picking(dataset, **picking)
        try:
            outcomes = pick_keypoints(found, say=say, opened=opened, port=options["port"] or 0)
        except KeyboardInterrupt:
            say("interrupted: nothing was saved; what was picked is kept, and the same command goes on with it.")
            raise typer.Exit(130) from None
    for outcome in outcomes:
        show_outcome(outcome)
    if not outcomes:
        say("nothing was saved; the same command goes on with what was picked.")
    return outcomes


def _open_in_browser(url: str) -> None:
    import webbrowser

    from bask_data.view.windows import has_display

    if has_display():
        webbrowser.open(url)


for _stage in STAGES:
    _add_stage(_stage)


# Ingest ---------------------------------------------------------------------------------------------------------------


def _add_format(format: Format) -> None:
    source = Annotated[
        Path, typer.Argument(help="The recording's folder.", metavar="SOURCE", exists=True, file_okay=False)
    ]
    scene = Annotated[str, typer.Option("--scene", help="Name of the recording in the dataset.", metavar="NAME")]
    as_ = Annotated[
        Literal["scan", "demonstration"], typer.Option("--as", help="A scan of a static scene, or a demonstration.")
    ]
    replace = Annotated[bool, typer.Option("--force", help="Replace a recording of that name.")]
    parameters = [
        _parameter("source", source, inspect.Parameter.empty),
        _parameter("root", Root, inspect.Parameter.empty),
        _parameter("scene", scene, inspect.Parameter.empty),
        _parameter("as_", as_, "scan"),
        *[_option(name, field) for name, field in format.options.model_fields.items()],
        _parameter("force", replace, False),
        _parameter("json_", Json, False),
    ]

    def body(source: Path, root: Path, scene: str, as_: Any, force: bool, json_: bool, **options: Any) -> None:
        from bask_data.stages.ingest import ingest

        values = _model_values(format.options, options, f"bask-data ingest {format.name}")
        with shown_progress():
            outcomes, assumptions = ingest(
                root, scene, format=format, source=source, options=values, kind=as_, force=force
            )
        for name, text in assumptions.items():
            say(f"  assumed     {name}: {text}")
        for outcome in outcomes:
            show_outcome(outcome)
        _finish(f"ingest {format.name}", outcomes, json_, f"bask-data run {_quoted(root)}", assumptions=assumptions)

    _command(ingest_app, format.name, format.help, parameters, body)


for _format in FORMATS:
    _add_format(_format)


def _add_simulator() -> None:
    def counted(what: str) -> Any:
        return Annotated[int, typer.Option(min=0, help=f"Number of {what}.")]

    only = Annotated[
        str, typer.Option(help="Only these, whatever the numbers say: lid_scan0,lid_demo3.", metavar="NAMES")
    ]
    fields = SimOptions.model_fields
    task = Annotated[TaskName, typer.Option("--task", help=fields["task"].description)]
    parameters = [
        _parameter("root", Root, inspect.Parameter.empty),
        _parameter("task", task, inspect.Parameter.empty),
        _parameter("scans", counted("scans of the objects, each in another place"), 5),
        _parameter("demonstrations", counted("demonstrations of the task"), 14),
        *[_option(name, field) for name, field in fields.items() if name != "task"],
        _parameter("only", only, ""),
        _parameter("force", Annotated[bool, typer.Option("--force", help="Replace recordings of those names.")], False),
        _parameter("json_", Json, False),
    ]

    def body(root: Path, scans: int, demonstrations: int, only: str, force: bool, json_: bool, **options: Any) -> None:
        from bask_data.stages.simulate import simulate

        values = _model_values(SimOptions, options, "bask-data ingest sim")
        assert isinstance(values, SimOptions)
        with shown_progress():
            outcomes, n_failed = simulate(
                root, values, n_scans=scans, n_demonstrations=demonstrations, only=_names(only), force=force
            )
        for outcome in outcomes:
            show_outcome(outcome)
        if n_failed:
            say(f"  note: {n_failed} demonstrations failed at the task and were drawn anew")
        following = f"bask-data run {_quoted(root)}"
        _finish("ingest sim", outcomes, json_, following, failed_demonstrations=n_failed)

    help_ = "Simulate a tabletop task: scans and demonstrations whose truth is known exactly."
    _command(ingest_app, "sim", help_, parameters, body)


_add_simulator()


# The dataset ----------------------------------------------------------------------------------------------------------


@app.command()
@_reporting
def init(
    root: Root,
    name: Annotated[str, typer.Option(help="Name of the dataset; by default the directory's.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the data: an SPDX identifier.")] = "",
    json_: Json = False,
) -> None:
    """Make an empty dataset."""
    dataset = Dataset.create(root, name, licence)
    say(f"made {dataset.root / DATASET}")
    if json_:
        print(json.dumps({"command": "init", "root": str(root), "name": dataset.file.name}))
    say(f"next: bask-data ingest frames SOURCE {_quoted(root)} --scene NAME ...")


@app.command("run")
@_reporting
def run_all(
    root: Root,
    only: Only = "",
    jobs: Jobs = 1,
    cluster: Cluster = "",
    force: Force = False,
    config: ConfigFile = None,
    preset: Preset = None,
    set_: Set = [],  # noqa: B006  # Typer copies it.
    dry_run: DryRun = False,
    json_: Json = False,
) -> None:
    """Make everything that is missing or stale, in order."""
    dataset = Dataset(root)
    dataset.recover()
    parameters = _parameters(root, config, set_, preset)
    chosen = _chosen_recordings(dataset, only)
    names = chosen if only else []
    planned = []
    for stage in STAGES:
        items = [name for name in names if name in dataset.items(stage.makes.scope)]
        if names and stage.makes.scope != "dataset" and not items:
            continue
        for variant in dataset.variants(stage.makes):
            planned.append(plan(dataset, stage, config=parameters, only=items, variant=variant))
    # All are planned before any is made: a bad parameter of a late stage must not cost the time of the first.
    outcomes: list[Outcome] = []
    coming: set[Path] = set()
    with shown_progress(), _executor(jobs, cluster) as executor:
        for tasks in planned:
            for outcome in foretold(tasks, coming, force) if dry_run else run(tasks, executor=executor, force=force):
                show_outcome(outcome)
                _show_findings(outcome)
                outcomes.append(outcome)
    _finish("run", outcomes, json_, AFTER_DRY_RUN if dry_run else f"bask-data report {_quoted(root)}")


@app.command()
@_reporting
def status(
    root: Root,
    config: ConfigFile = None,
    preset: Preset = None,
    set_: Set = [],  # noqa: B006
    json_: Json = False,
) -> None:
    """Say of every artifact whether it is up to date, and if not, why."""
    dataset = Dataset(root)
    parameters = _parameters(root, config, set_, preset)
    rows: list[tuple[str, str, State]] = []
    for stage in STAGES:
        for variant in dataset.variants(stage.makes):
            for task in plan(dataset, stage, config=parameters, variant=variant):
                rows.append((stage.name, task.label, state_told(task)))
    for _, label, state in rows:
        say(f"  {state.status:<10}  {label}{f'  ({state.why})' if state.why else ''}")
    n_todo = sum(state.status != "up to date" for _, _, state in rows)
    if json_:
        found = [
            {"stage": stage, "label": label, "status": state.status, "why": state.why} for stage, label, state in rows
        ]
        print(json.dumps({"command": "status", "artifacts": found}, indent=2))
    say(f"next: bask-data run {_quoted(root)}" if n_todo else "everything is up to date.")


@app.command()
@_reporting
def info(root: Root, json_: Json = False) -> None:
    """Say what a dataset holds."""
    from bask_data.validate import artifacts_on_disk, total_bytes

    dataset = Dataset(root)
    file = dataset.file
    say(
        f"{file.name}: {len(file.scenes)} scenes, {len(file.demonstrations)} demonstrations, "
        f"licence {file.licence or 'not stated'}"
    )
    rows = []
    for artifact in artifacts_on_disk(dataset):
        manifest = artifact.manifest
        rows.append(
            {
                "artifact": artifact.path.relative_to(dataset.root).as_posix(),
                "made_by": f"{manifest.stage} v{manifest.stage_version}",
                "bytes": total_bytes(manifest.files),
                "digest": manifest.digest,
                "metadata": {key: value for key, value in artifact.attributes.items() if key not in ("kind", "schema")},
                "cameras": _camera_sizes(artifact),
            }
        )
        cameras = ", ".join(f"{name} {size}" for name, size in rows[-1]["cameras"].items())  # type: ignore[attr-defined]
        megabytes = total_bytes(manifest.files) / 1e6
        say(f"  {rows[-1]['artifact']:<40} {megabytes:9.1f} MB  {manifest.digest[:12]}  {cameras}")
    for name, scenes in file.splits.model_dump().items():
        if scenes:
            say(f"  {name}: {', '.join(scenes)}")
    if json_:
        print(json.dumps({"command": "info", "dataset": file.model_dump(mode="json"), "artifacts": rows}, indent=2))


def _camera_sizes(artifact: Any) -> dict[str, str]:
    from bask_data.kinds import Recording

    if not isinstance(artifact, Recording):
        return {}
    return {camera.name: f"{camera.n_frames} x {camera.width}x{camera.height}" for camera in artifact.cameras}


@app.command()
@_reporting
def validate(root: Root, json_: Json = False) -> None:
    """Hold every file against its SHA-256 and every array against its schema."""
    from bask_data.validate import artifacts_on_disk
    from bask_data.validate import validate as find_problems

    dataset = Dataset(root)
    with shown_progress():
        problems = find_problems(dataset)
    for problem in problems:
        say(f"error: {problem}")
    if json_:
        print(json.dumps({"command": "validate", "problems": [vars(problem) for problem in problems]}, indent=2))
    if problems:
        say(f"{len(problems)} problems.")
        raise typer.Exit(4)
    say(f"{len(artifacts_on_disk(dataset))} artifacts, no problem.")


@app.command()
@_reporting
def split(
    root: Root,
    train: Annotated[str, typer.Option(help="Scenes to train on, separated by commas.", metavar="NAMES")] = "",
    validation: Annotated[str, typer.Option(help="Scenes to validate on.", metavar="NAMES")] = "",
    test: Annotated[str, typer.Option(help="Scenes kept for the test.", metavar="NAMES")] = "",
    json_: Json = False,
) -> None:
    """Say which scenes are for training, validation and test; never splits the frames of a scene."""
    splits = Splits(train=tuple(_names(train)), validation=tuple(_names(validation)), test=tuple(_names(test)))
    Dataset(root).set_splits(splits)
    if json_:
        print(json.dumps({"command": "split", **splits.model_dump(mode="json")}))
    say(f"next: bask-data train {_quoted(root)}")


@app.command()
@_reporting
def dvc(
    root: Root,
    config: ConfigFile = None,
    preset: Preset = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only say whether the files are what would be written.")
    ] = False,
    json_: Json = False,
) -> None:
    """Write dvc.yaml and params.yaml, so that `dvc repro` runs and records the pipeline."""
    from bask_data.dvc import render

    dataset = Dataset(root)
    rendered = render(dataset, STAGES, _parameters(root, config, [], preset))
    stale = [name for name, text in rendered.items() if not (root / name).exists() or (root / name).read_text() != text]
    if json_:
        print(json.dumps({"command": "dvc", "files": sorted(rendered), "changed": stale}))
    if check:
        if stale:
            raise UsageError(
                root,
                ", ".join(stale),
                expected="what the code renders",
                got="something else",
                fix=f"bask-data dvc {root}",
            )
        return
    for name in stale:
        (root / name).write_text(rendered[name])
        say(f"made {root / name}")
    for stage in STAGES:
        for variant in dataset.variants(stage.makes):
            dataset.prepare(stage.makes, variant)
    say(f"next: dvc repro {_quoted(root / 'dvc.yaml')}")


@evaluate_app.command("masks")
@_reporting
def evaluate_masks(root: Root, only: Only = "", json_: Json = False) -> None:
    """Objects found, and IoU of their visible masks with the labels.

    Bodies that touch count as one object: geometry cannot tell them apart.
    """
    from bask_data.evaluation import evaluated_masks

    with shown_progress():
        found = evaluated_masks(Dataset(root), _names(only))
    for scene, score in found["scenes"].items():
        say(f"  {scene}: {score['n_found']} objects found, {len(score['objects'])} are there")
        for one in score["objects"]:
            say(f"    {'+'.join(one['names']):<32} instance {one['instance'] or 'none':<4}  IoU {one['iou']:.3f}")
    _show_figures(found["all"])
    if json_:
        print(json.dumps({"command": "evaluate masks", **found}, indent=2))


@evaluate_app.command("correspondences")
@_reporting
def evaluate_correspondences(root: Root, only: Only = "", json_: Json = False) -> None:
    """Pixels between the matches and where the exact depth and cameras say they belong."""
    from bask_data.evaluation import evaluated_correspondences

    with shown_progress():
        found = evaluated_correspondences(Dataset(root), _names(only))
    for scene, figures in found["scenes"].items():
        say(f"  {scene}")
        _show_figures(figures)
    say("  all scenes")
    _show_figures(found["all"])
    if json_:
        print(json.dumps({"command": "evaluate correspondences", **found}, indent=2))


@evaluate_app.command("descriptor")
@_reporting
def evaluate_descriptor(
    root: Root,
    variant: Annotated[
        str, typer.Option(help="Networks to measure beside each other, separated by commas.", metavar="NAMES")
    ] = "main",
    scenes: Annotated[
        str, typer.Option(help="Scenes to measure on. [default: what was held out of training]", metavar="NAMES")
    ] = "",
    pairs: Annotated[int, typer.Option(min=1, help="Most pairs of frames, of each scene.")] = 100,
    sweep: Annotated[
        bool, typer.Option("--sweep/--no-sweep", help="Zoom and turn some of the views by given amounts, too.")
    ] = True,
    keypoints: Annotated[
        int, typer.Option(min=0, help="Keypoints picked in a view trained on, to look for in others; 0 is none.")
    ] = 16,
    against: Annotated[
        list[str],
        typer.Option(
            help="A further dataset whose truth names the same objects, to look for the keypoints in: other instances, "
            "other surroundings. May be repeated.",
            metavar="NAME=ROOT",
        ),
    ] = [],  # noqa: B006  # Typer copies it.
    alpha: Annotated[
        float, typer.Option(min=0, help="Temperature of the heat maps whose truthfulness is measured.")
    ] = 4.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the pairs and their matches.")] = 0,
    json_: Json = False,
) -> None:
    """How well networks find in held-out views what they saw in others.

    By exact depth and cameras where truth knows them, else by the dataset's own matches; told apart by change of scale,
    rotation, occlusion and object.
    """
    from bask_data.evaluation import evaluated_descriptor
    from bask_data.evaluation.tables import descriptor_tables

    with shown_progress():
        found = evaluated_descriptor(
            Dataset(root),
            _names(variant),
            scenes=_names(scenes),
            pairs=pairs,
            sweep=sweep,
            keypoints=keypoints,
            against=_named_datasets(against),
            alpha=alpha,
            seed=seed,
        )
    for line in descriptor_tables(found):
        say(line)
    if json_:
        print(json.dumps({"command": "evaluate descriptor", **found}, indent=2))


@evaluate_app.command("keypoints")
@_reporting
def evaluate_keypoints(
    root: Root,
    variant: Annotated[
        str,
        typer.Option(
            help="Networks to track with, by commas: all filters with the first, single frames with the others.",
            metavar="NAMES",
        ),
    ] = "main",
    demonstrations: Annotated[
        str, typer.Option(help="Demonstrations to track in. [default: all with truth]", metavar="NAMES")
    ] = "",
    objects: Annotated[
        str, typer.Option(help="Objects to put keypoints on. [default: all of a demonstration]", metavar="NAMES")
    ] = "",
    cameras: Annotated[
        str, typer.Option(help="Cameras to track with, `wrist` in the paper. [default: all]", metavar="NAMES")
    ] = "",
    reference: Annotated[
        str,
        typer.Option(help="Reference keypoints to track. [default: points spread over the objects]", metavar="VARIANT"),
    ] = "",
    pick_in: Annotated[
        str,
        typer.Option(
            help="Recordings to choose these points in, the first with the objects; a demonstration in the paper. "
            "[default: scans that networks learn from]",
            metavar="NAMES",
        ),
    ] = "",
    keypoints: Annotated[int, typer.Option(min=1, help="Number of points, shared among the objects.")] = 16,
    settings: Annotated[
        Literal["default", "paper", "code"],
        typer.Option(help="Settings of the filters: our own, the paper's, or its authors' code's."),
    ] = "default",
    pictures: Annotated[
        Path | None, typer.Option(help="Draw the figures into this folder, as PNG.", metavar="DIR")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the points and of the particle filter.")] = 0,
    json_: Json = False,
) -> None:
    """How right tracked keypoints are, over time and by what the cameras see of them.

    Single frames, discrete and particle filter, on demonstrations whose truth knows where the objects are. The dataset
    keeps the result in evaluation/keypoints.json, for its report.
    """
    from bask_data.evaluation import evaluated_keypoints
    from bask_data.evaluation.keypoint_study import save_study
    from bask_data.evaluation.tables import keypoint_tables
    from bask_data.report.study import write_pictures

    dataset = Dataset(root)
    with shown_progress():
        found = evaluated_keypoints(
            dataset,
            _names(variant),
            demonstrations=_names(demonstrations),
            objects=_names(objects),
            cameras=_names(cameras),
            reference=reference,
            pick_in=_names(pick_in),
            n_keypoints=keypoints,
            settings=settings,
            seed=seed,
        )
    made = [save_study(dataset, found), *(write_pictures(dataset, found, pictures) if pictures else [])]
    for line in keypoint_tables(found):
        say(line)
    for file in made:
        say(f"made {file}")
    if json_:
        print(json.dumps({"command": "evaluate keypoints", "files": [str(file) for file in made], **found}, indent=2))
    say(f"next: bask-data report {_quoted(root)}")


def _named_datasets(given: Sequence[str]) -> dict[str, Dataset]:
    """Of NAME=ROOT."""
    found = {}
    for text in given:
        name, is_pair, root = text.partition("=")
        if not (name and is_pair and root):
            raise UsageError("evaluate descriptor", "--against", expected="NAME=ROOT", got=text)
        if name in found:
            raise UsageError("evaluate descriptor", "--against", expected="names that differ", got=f"{name} twice")
        found[name] = Dataset(root)
    return found


def _show_figures(figures: dict[str, float | None]) -> None:
    for name, value in figures.items():
        say(f"    {name:<14} {'unknown' if value is None else f'{value:.4g}'}")


@app.command()
@_reporting
def report(
    root: Root,
    out: Annotated[Path | None, typer.Option(help="File to write. [default: ROOT/report.html]", metavar="FILE")] = None,
    json_: Json = False,
) -> None:
    """Write one HTML page with pictures of everything the dataset holds, and how good it is."""
    from bask_data.report import measure, summarise, write_report

    dataset = Dataset(root)
    with shown_progress():
        measured = measure(dataset)
        file = write_report(dataset, out or root / "report.html", measured)
        if json_:
            print(json.dumps({"command": "report", "file": str(file), **summarise(dataset, measured)}, indent=2))
    say(f"made {file}  (open it in a browser)")


@app.command()
@_reporting
def view(
    root: Root,
    only: Only = "",
    save: Annotated[
        Path | None, typer.Option(help="Write the recording to this file, ending in .rrd.", metavar="FILE")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Show it in a browser; needs no display here.")] = False,
    port: Annotated[
        int | None,
        typer.Option(help="With --web: of the viewer; the next one is taken too. [default: 9090]", min=1, max=65534),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Show each so many-th frame.")] = 1,
    pairs: Annotated[int, typer.Option(min=0, help="Most pairs of views whose matches are shown, a scene.")] = 40,
    variant: Annotated[str, typer.Option(help="Of network, heat maps and keypoints.", metavar="NAME")] = "main",
    beliefs: Annotated[
        bool, typer.Option("--beliefs", help="Track again, to show the filter's particles or maps in each frame.")
    ] = False,
    video: Annotated[
        Path | None,
        typer.Option(
            help="Instead: keypoints over frames, an mp4 of each demonstration in this folder.", metavar="DIR"
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files.")] = False,
    json_: Json = False,
) -> None:
    """Walk through scenes and demonstrations in the Rerun viewer, or save what it shows."""
    from tempfile import TemporaryDirectory

    from bask_data.kinds import DescriptorNet, KeypointTrack, ReferenceKeypoints
    from bask_data.view import Choice, save_recording
    from bask_data.view.windows import has_display, serve, show

    dataset = Dataset(root)
    items = _chosen_recordings(dataset, only)
    kinds = DescriptorNet, ReferenceKeypoints, KeypointTrack
    variants = dict.fromkeys(name for kind in kinds for name in dataset.variants(kind))
    if variant not in variants:
        raise UsageError(root, "--variant", expected=f"one of {', '.join(variants)}", got=variant)
    if video is not None:
        _write_videos(dataset, video, items, variant, every, force, json_)
        return
    if port is not None and not web:
        raise UsageError("view", "--port", expected="to come with --web", got="it alone", fix="--web --port N")
    if not (save or web or has_display()):
        raise UsageError(
            "view", "", expected="a display to open a window on", got="none", fix="use --web, or --save FILE.rrd."
        )
    with TemporaryDirectory(prefix="bask-data-") as folder:
        file = save or Path(folder) / f"{root.resolve().name}.rrd"
        with shown_progress():
            shown = save_recording(dataset, file, Choice(items, every, pairs, variant, beliefs), force=force)
        for name, one in shown.items():
            _show_shown(name, one)
        if json_:
            found = {name: vars(one) for name, one in shown.items()}
            saved = {"file": str(save) if save else None, "bytes": file.stat().st_size}
            print(json.dumps({"command": "view", **saved, "items": found}, indent=2), flush=True)
        if save:
            say(f"made {file}  ({file.stat().st_size / 1e6:.1f} MB; open it with: rerun {_quoted(file)})")
        if web:
            serve(file, port or 9090, say=lambda url: say(f"open {url}  (Ctrl-C ends it)"))
        elif not save:
            show(file)


def _write_videos(
    dataset: Dataset, folder: Path, items: Sequence[str], variant: str, every: int, force: bool, json_: bool
) -> None:
    from bask_data.view.video import write_videos

    with shown_progress():
        files = write_videos(dataset, folder, items, variant=variant, every=every, force=force)
    for file in files.values():
        say(f"made {file}")
    if json_:
        print(json.dumps({"command": "view", "videos": {name: str(file) for name, file in files.items()}}, indent=2))


def _chosen_recordings(dataset: Dataset, only: str) -> list[str]:
    """Scenes and demonstrations by name, or all; there must be some."""
    names, there = _names(only), dataset.items("recording")
    unknown = [name for name in names if name not in there]
    if unknown:
        known = ", ".join(there) or "no items yet"
        raise UsageError(dataset.root, "--only", expected=f"one of {known}", got=", ".join(unknown))
    if not there:
        fix = "bask-data ingest --help"
        raise UsageError(dataset.root, "", expected="a recording", got="none in the dataset", fix=fix)
    return list(dict.fromkeys(names)) or there


def _show_shown(name: str, one: Any) -> None:
    frames = ", ".join(f"{n} frames of {camera}" for camera, n in one.frames.items())
    layers = ", ".join(layer for layer in one.layers if layer != "frames")
    say(f"  shown       {name}: {'; '.join(part for part in (frames, layers) if part) or 'nothing'}")
    if one.missing:
        say(f"  not there   {name}: {', '.join(one.missing)}")


@app.command("export")
@_reporting
def export_(
    format: Annotated[
        FormatName,
        typer.Argument(help="parquet: tables. lerobot: dataset v3. robomimic: HDF5. diffusion-policy: replay buffer."),
    ],
    root: Root,
    out: Annotated[Path, typer.Argument(help="Folder to write; robomimic: file, ending in .hdf5.", metavar="OUT")],
    variant: Annotated[str, typer.Option(help="Of the keypoints.", metavar="NAME")] = "main",
    noise: Annotated[
        float, typer.Option(help="Standard deviation of noise added to keypoints, metres; the paper's policies: 0.02.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    videos: Annotated[bool, typer.Option("--videos", help="Take the cameras' images along.")] = False,
    only: Annotated[str, typer.Option(help="Only these demonstrations, separated by commas.", metavar="NAMES")] = "",
    validation: Annotated[str, typer.Option(help="Demonstrations to validate on.", metavar="NAMES")] = "",
    test: Annotated[str, typer.Option(help="Demonstrations kept for the test.", metavar="NAMES")] = "",
    task: Annotated[
        str, typer.Option(help="What is done, in words. [default: as the source says, or else the dataset's name]")
    ] = "",
    force: Annotated[bool, typer.Option("--force", help="Replace an export.")] = False,
    json_: Json = False,
) -> None:
    """Write demonstrations with their keypoints as the files that policies are learned from."""
    from bask_data.export import Choice, export

    dataset = Dataset(root)
    choice = Choice(
        variant, _names(only), _names(validation), _names(test), noise=noise, seed=seed, videos=videos, task=task
    )
    with shown_progress():
        done = export(dataset, out, format, choice, force=force)
    for note in done.notes:
        say(f"  note: {note}")
    counts = ", ".join(f"{len(names)} for {split}" for split, names in done.splits.items() if names)
    say(f"made {out}  ({counts}; {done.n_frames} frames; {done.n_bytes / 1e6:.1f} MB)")
    if json_:
        print(json.dumps({"command": "export", **vars(done)}, indent=2))
    say(f"next: {done.opened_with}")


@app.command()
@_reporting
def doctor(
    folder: Annotated[Path | None, typer.Option(help="Where datasets will go: is there room?", metavar="DIR")] = None,
    json_: Json = False,
) -> None:
    """Say what this machine lacks, and the line that brings it."""
    from bask_data import doctor as examiner

    found = examiner.checks(folder)
    say(examiner.render(found))
    if json_:
        print(examiner.as_json(found))
    if examiner.missing(found):
        raise typer.Exit(MissingDependency.exit_code)


if __name__ == "__main__":
    main()
