"""`ingest`: a sub-command per format, and the simulator."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from bask_data.cli.commands import CommandList
from bask_data.cli.console import say, show_outcome, shown_progress
from bask_data.cli.ingest_auto import ingest_auto
from bask_data.cli.ingest_run import IngestRequest, run_ingest
from bask_data.cli.options import Json, Root, add_command, checked_options, names_of, options_of, parameter
from bask_data.cli.working import finish, quoted
from bask_data.formats import FORMATS, Format
from bask_data.sim.options import SimOptions, TaskName

EXAMPLES = {
    "auto": """
    bask-data ingest auto recordings/table data/demo
    bask-data ingest auto scans/mug.r3d data/demo --scene mug --yes
    """,
    "frames": """
    bask-data ingest frames recordings/table data/demo --scene table --intrinsics 525,525,319.5,239.5
    bask-data ingest frames recordings/pour data/demo --scene pour1 --as demonstration --camera wrist
    """,
    "tum": """
    bask-data ingest tum rgbd_dataset_freiburg1_desk data/demo --scene desk --intrinsics freiburg1
    """,
    "scannet": """
    bask-data ingest scannet scans/scene0000_00/exported data/rooms --scene office
    bask-data ingest scannet scans/scene0000_00/scene0000_00.sens data/rooms --scene office --frames ::10
    """,
    "arkitscenes": """
    bask-data ingest arkitscenes raw/Training/47333462 data/rooms --scene bedroom --frames ::6
    bask-data ingest arkitscenes raw/Training/47333462 data/rooms --scene bedroom --color vga_wide --confidence 2
    """,
    "bop": """
    bask-data ingest bop ycbv/test/000048 data/ycbv --scene scene48
    bask-data ingest bop YCB_Video_Dataset/data data/ycbv --episode 0000 --scene scene0
    """,
    "lerobot": """
    bask-data ingest lerobot pour data/demo --scene pour --as demonstration --episode all --intrinsics wrist.txt
    bask-data ingest lerobot exported data/again --scene demo0 --as demonstration --episode 0
    """,
    "colmap": """
    bask-data ingest colmap recordings/shelf data/demo --scene shelf --align-to robot_poses.json
    bask-data ingest colmap recordings/phone data/demo --scene desk --intrinsics 615,615,319.5,239.5
    """,
    "apc": """
    bask-data ingest apc datasets/apc_shelf data/demo --scene shelf
    """,
    "rlbench": """
    bask-data ingest rlbench rlbench/open_drawer/variation0 data/drawer --scene open --as demonstration --episode 3
    """,
    "maniskill": """
    bask-data ingest maniskill trajectory.rgbd.pd_ee_delta_pose.physx_cpu.h5 data/cubes --scene pick --as demonstration
    """,
    "nerfstudio": """
    bask-data ingest nerfstudio scans/mug data/demo --scene mug
    bask-data ingest nerfstudio captures/desk data/demo --scene desk --depth-scale 0.0001 --skip-bad
    """,
    "polycam": """
    bask-data ingest polycam captures/shelf.zip data/demo --scene shelf
    bask-data ingest polycam captures/shelf data/demo --scene shelf --confidence 54
    """,
    "record3d": """
    bask-data ingest record3d 2024-05-17--10-12-30.r3d data/demo --scene desk
    bask-data ingest record3d EXR_RGBD data/demo --scene desk --frames ::10 --skip-bad
    """,
    "stray": """
    bask-data ingest stray recordings/71de12f9 data/demo --scene desk --confidence 1 --frames ::6
    """,
    "robomimic": """
    bask-data ingest robomimic can/image_depth.hdf5 data/cans --scene can --as demonstration --episode demo_7
    """,
    "rosbag": """
    bask-data ingest rosbag table.bag data/demo --scene table --frames ::10
    bask-data ingest rosbag bags/pour data/demo --scene pour1 --as demonstration --gripper-frame tool0
    """,
    "sim": """
    bask-data ingest sim data/demo --task lid
    bask-data ingest sim data/demo --task phone --scans 10 --demonstrations 20 --clutter 4
    """,
}

Scene = Annotated[str, typer.Option("--scene", help="Name of the recording in the dataset.", metavar="NAME")]
As = Annotated[
    Literal["scan", "demonstration"], typer.Option("--as", help="A scan of a static scene, or a demonstration.")
]

Picture = Annotated[
    Path | None,
    typer.Option("--picture", help="Write a picture of depth's edges over colour: do they lie on each other?"),
]
Report = Annotated[
    Path | None,
    typer.Option(
        "--report",
        help="Write the doctor's page about the source, also if it is refused: findings, evidence, pictures.",
        metavar="FILE",
    ),
]

app = CommandList(
    name="ingest",
    no_args_is_help=True,
    help="Read a recording into a dataset; one sub-command per format.",
    epilog=EXAMPLES["frames"],
)


@app.callback()
def _group() -> None:
    """A callback makes this a group: `ingest FORMAT`."""


def _add_format(format: Format) -> None:
    source_type = Annotated[Path, typer.Argument(help=format.wants, metavar="SOURCE", exists=True)]
    parameters = [
        parameter("source", source_type, inspect.Parameter.empty),
        parameter("root", Root, inspect.Parameter.empty),
        parameter("scene", Scene, inspect.Parameter.empty),
        parameter("as_", As, "scan"),
        *options_of(format.name, format.options),
        _replace("Replace an existing recording."),
        parameter("picture", Picture, None),
        parameter("report", Report, None),
        parameter("json_", Json, False),
    ]

    def body(source: Path, root: Path, scene: str, as_: Any, json_: bool, **options: Any) -> None:
        given = {name: options.pop(name) for name in ("force", "picture", "report")}
        run_ingest(IngestRequest(format, source, root, scene, as_, options, as_json=json_, **given))

    add_command(app, format.name, parameters, body, help=format.help, epilog=EXAMPLES.get(format.name))


def _replace(help: str) -> inspect.Parameter:
    return parameter("force", Annotated[bool, typer.Option("--force", help=help)], False)


def _add_simulator() -> None:
    def counted(what: str) -> Any:
        return Annotated[int, typer.Option(min=0, help=f"Number of {what}.")]

    only = typer.Option(help="Only these, regardless of the numbers: lid_scan0,lid_demo3.", metavar="NAMES")
    task = typer.Option("--task", help=SimOptions.model_fields["task"].description)
    parameters = [
        parameter("root", Root, inspect.Parameter.empty),
        parameter("task", Annotated[TaskName, task], inspect.Parameter.empty),
        parameter("scans", counted("scans of the objects, each in another arrangement"), 5),
        parameter("demonstrations", counted("demonstrations of the task"), 14),
        parameter("only", Annotated[str, only], ""),
        *options_of("sim", SimOptions, without=("task",)),
        _replace("Replace existing recordings."),
        parameter("json_", Json, False),
    ]

    def body(root: Path, scans: int, demonstrations: int, only: str, force: bool, json_: bool, **options: Any) -> None:
        from bask_data.sources.simulate import simulate

        values = checked_options(SimOptions, options, "bask-data ingest sim")
        assert isinstance(values, SimOptions)
        with shown_progress():
            outcomes, n_failed = simulate(
                root, values, n_scans=scans, n_demonstrations=demonstrations, only=names_of(only), force=force
            )
        for outcome in outcomes:
            show_outcome(outcome)
        if n_failed:
            say(f"  note: {n_failed} demonstrations failed at the task and were replaced by others")
        following = f"bask-data run {quoted(root)}"
        finish("ingest sim", outcomes, json_, following, failed_demonstrations=n_failed)

    help = "Simulate a tabletop task: scans and demonstrations with exact ground truth."
    add_command(app, "sim", parameters, body, help=help, epilog=EXAMPLES["sim"])


app.command("auto", epilog=EXAMPLES["auto"])(ingest_auto)
for _format in FORMATS:
    _add_format(_format)
_add_simulator()
