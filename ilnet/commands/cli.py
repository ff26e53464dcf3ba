"""The command line: `python -m ilnet COMMAND`."""

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import click

from ilnet import memory

__all__ = ["main"]

_SIZES = "16x1024,64x1024,128x2048,256x4096"
# Those of `experiment.EXPERIMENTS`, which takes seconds to import.
_EXPERIMENTS = (
    "table",
    "convergence",
    "attention",
    "rays",
    "real",
    "surfaces",
    "confidence",
    "sensors",
    "fair",
    "alignment",
    "where",
    "odometry",
    "thin",
    "all",
)


class _Size(click.ParamType):
    """Rows and columns of a range image."""

    name = "ROWSxCOLUMNS"

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> tuple[int, int]:
        """Returns both numbers."""
        from ilnet.sensor import parse_size

        try:
            return parse_size(str(value))
        except ValueError as error:
            self.fail(str(error), parameter, context)


def _limit_memory(context: click.Context, parameter: click.Parameter, value: float) -> None:
    context.with_resource(memory.limited(value * 1e9))


_max_memory = click.option(
    "--max-memory",
    type=click.FloatRange(min=0, min_open=True),
    default=memory.LIMIT / 1e9,
    show_default=True,
    metavar="GB",
    expose_value=False,
    callback=_limit_memory,
    help="Refuse a file or a size that would take more memory.",
)


# Commands import what they need when they run, so that `--help` and a mistyped option answer at once.


@click.group(context_settings={"help_option_names": ["-h", "--help"]}, invoke_without_command=True)
@click.pass_context
def cli(context: click.Context) -> None:
    """Implicit LiDAR Network: dense range images from sparse ones."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@cli.command()
@click.option("--mesh", type=Path, metavar="FILE", help="Scan this mesh (metres, z up) instead of the town.")
@click.option("--at", type=(float, float, float), metavar="X Y Z", help="Position of the sensor in the mesh [m].")
@click.option("--scan", type=Path, metavar="FILE", help="Keep some beams of this scan; predict all.")
@click.option("--rows", type=int, metavar="N", help="Beams of the scan to keep; 16 by default.")
@click.option(
    "--sensor", metavar="NAME|FILE", help="Preset or table with the scan's angles, if the file does not hold them."
)
@click.option("--out", type=Path, default=Path("demo_output"), show_default=True, help="Folder for the pictures.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of the table.")
@_max_memory
def demo(
    mesh: Path | None,
    at: tuple[float, float, float] | None,
    scan: Path | None,
    rows: int | None,
    sensor: str | None,
    out: Path,
    as_json: bool,
) -> None:
    """Upsample a scan with every method: a table, pictures, a point cloud."""
    if mesh and scan:
        raise click.UsageError("--mesh and --scan exclude each other")
    if bool(mesh) != (at is not None):
        raise click.UsageError("--mesh FILE and --at X Y Z go together")
    if not scan and (rows is not None or sensor is not None):
        raise click.UsageError("--rows and --sensor go with --scan FILE")
    from ilnet.commands import demo
    from ilnet.learning import evaluate
    from ilnet.sensor import PAPER_TARGET

    if mesh and at:
        [pair], source = evaluate.mesh_pairs(mesh, [at], PAPER_TARGET), mesh.name
    elif scan:
        pair, source = _scan_pair(scan, rows, sensor), scan.name
    else:
        pair, source = demo.from_town(), demo.TOWN
    result = demo.run(*pair, out, source)
    if as_json:
        click.echo(json.dumps(result))
        return
    click.echo(f"{source}: {result['input']} -> {result['output']}\n")
    click.echo(_table(result["methods"]))
    click.echo(f"\nrange images, 3-D picture and point cloud: {out}/")


@cli.command()
@click.argument("model")
@click.option("--preset", default="tiny", show_default=True, help="Size of the network and of its training.")
@click.option("--steps", type=click.IntRange(min=1), help="Optimiser steps, instead of the preset's.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of weights and rays.")
@click.option("--data", type=Path, metavar="DIR", help="Learn from stored images: an archive or a tree of .rimg files.")
@click.option("--size", type=_Size(), help="Size of the stored images; 128x2048 by default.")
@click.option(
    "--sensors",
    metavar="any|NAMES",
    help="Input sensors of the rays: presets or tables, comma separated, or any. The paper's by default; any for "
    "iln-surfaces.",
)
@click.option("--out", type=Path, default=Path("runs"), show_default=True, help="Folder for weights, figures, logs.")
@_max_memory
def train(
    model: str,
    preset: str,
    steps: int | None,
    seed: int,
    data: Path | None,
    size: tuple[int, int] | None,
    sensors: str | None,
    out: Path,
) -> None:
    """Train MODEL on rays at continuous directions; an interrupted run in --out goes on where it stopped.

    `torchrun --nproc-per-node N -m ilnet train MODEL` shares each batch among N processes or GPUs.
    """
    from ilnet import sensor_files
    from ilnet.learning import train
    from ilnet.sensor import PAPER_INPUT, PAPER_TARGET

    if size and not data:
        raise click.UsageError("--size goes with --data DIR")
    if sensors and data:
        raise click.UsageError("--sensors and --data exclude each other: stored images have the sensor that took them")
    if not data and train.learns_from_images(model, preset):
        raise click.UsageError(
            f"{model} with preset {preset} learns from stored images: make some with `python -m ilnet simulate "
            f"--sizes {PAPER_INPUT.size},{PAPER_TARGET.size} --out DIR`, and name them with --data DIR"
        )
    wanted = None
    if sensors:
        wanted = [] if sensors == "any" else [sensor_files.named(name) for name in sensors.split(",")]
    figures = train.train(model, preset, out, steps, seed, data, size or PAPER_TARGET.shape, wanted)
    click.echo(f"{out / model}.safetensors: " + ", ".join(f"{name} {value:.3f}" for name, value in figures.items()))


@cli.command()
@click.argument("files", nargs=-1, type=Path)
@click.option(
    "--model", "names", multiple=True, required=True, metavar="NAME|FILE", help="A model to measure; may be repeated."
)
@click.option("--scene", metavar="TOWN|MESH", help="Scan this town, or this mesh file (metres, z up).")
@click.option("--at", type=Path, metavar="FILE", help='Positions in the mesh: {"positions": [[x, y, z], ...]} [m].')
@click.option(
    "--scan",
    "measured",
    type=Path,
    multiple=True,
    metavar="FILE|FOLDER",
    help="Keep some beams of this scan, or of each in a folder; predict all. May be repeated.",
)
@click.option("--rows", type=int, metavar="N", help="Beams of the scan to keep; 16 by default.")
@click.option(
    "--sensor", metavar="NAME|FILE", help="Preset or table with the scan's angles, if the file does not hold them."
)
@click.option(
    "--data",
    type=Path,
    metavar="DIR",
    help="Measure on stored scans: an archive, or a tree of .rimg files by the paper's authors.",
)
@click.option(
    "--input", "source", type=_Size(), help="Size of the stored scans to predict from; the smallest by default."
)
@click.option(
    "--size",
    type=_Size(),
    help="Rays to predict: of the scene, 128x2048 by default; of stored scans, each other size by default.",
)
@click.option(
    "--scans",
    type=click.IntRange(min=1),
    help="Scans of the scene or of the stored ones; by default 8 of a town, or all.",
)
@click.option(
    "--protocol", type=click.Choice(["kitti"]), help="Measure KITTI's files FILES, or those in folders, as others do."
)
@click.option(
    "--json", "as_json", is_flag=True, help="Print an object instead of the table, or a list for many models."
)
@_max_memory
def evaluate(
    files: tuple[Path, ...],
    names: tuple[str, ...],
    scene: str | None,
    at: Path | None,
    measured: tuple[Path, ...],
    rows: int | None,
    sensor: str | None,
    data: Path | None,
    source: tuple[int, int] | None,
    size: tuple[int, int] | None,
    scans: int | None,
    protocol: str | None,
    as_json: bool,
) -> None:
    """Measure models on scans of a scene, seen with 16x1024 rays, on measured or stored scans, or by a protocol."""
    if [bool(scene), bool(measured), bool(data), bool(protocol)].count(True) != 1:
        raise click.UsageError("give --scene TOWN|MESH, --scan FILE, --data DIR or --protocol kitti FILE")
    if bool(protocol) != bool(files):
        raise click.UsageError("--protocol kitti and FILES go together; --scan FILE names other scans")
    if not (scene or data) and (size or scans):
        raise click.UsageError("--size and --scans go with --scene or --data; a scan is judged at its own size")
    if (at and not scene) or (source and not data):
        raise click.UsageError("--at goes with --scene, and --input with --data")
    if not measured and (rows is not None or sensor is not None):
        raise click.UsageError("--rows and --sensor go with --scan FILE")
    from ilnet import models, scan_files
    from ilnet.learning import evaluate
    from ilnet.sensor import format_size
    from ilnet.world import simulate

    loaded = {name: models.load(name).to(simulate.best_device()) for name in names}
    if protocol:
        _evaluate_kitti(loaded, files, as_json)
        return
    pairs: Any
    if data:
        seen, wanted = (None if shape is None else format_size(shape) for shape in (source, size))
        stored = evaluate.stored_pairs(data, seen, wanted, scans)
        found = [(evaluate.summary(evaluate.scan_by_scan(loaded, pairs), pairs), pairs) for pairs in stored]
        if as_json:
            every = [result for results, _ in found for result in results]
            click.echo(_json(every[0] if len(every) == 1 else every))
            return
        for results, pairs in found:
            _echo_figures(f"{data}: {len(pairs)} scan(s) of {pairs.sizes[0]}", results, pairs)
        return
    if measured:
        pairs = [_scan_pair(path, rows, sensor) for named in measured for path in scan_files.listed(named)]
    else:
        pairs = _scene_pairs(str(scene), at, size, scans)
    figures = evaluate.scan_by_scan(loaded, pairs)
    results = evaluate.summary(figures, pairs)
    if as_json:
        click.echo(_json(results[0] if len(results) == 1 else results))
        return
    _echo_figures(f"{scene or ', '.join(map(str, measured))}: {len(pairs)} scan(s)", results, pairs)


def _echo_figures(title: str, results: list[dict[str, Any]], pairs: Any) -> None:
    click.echo(f"{title} -> {results[0]['size']}\n")
    click.echo(_table({result["model"]: result for result in results}))
    if len(pairs) > 1:
        click.echo("\n" + "\n".join(_intervals(results)))
    if unseen := results[0]["unseen"]:
        count = sum(truth.ranges.numel() for _, truth in pairs)
        click.echo(f"\n{unseen} of {count} pixels are left out: the sensor never looked there.")
    click.echo()


def _scene_pairs(scene: str, at: Path | None, size: tuple[int, int] | None, scans: int | None) -> list[Any]:
    """Returns pairs of scans of a town or a mesh."""
    from ilnet.learning import evaluate
    from ilnet.sensor import PAPER_INPUT, PAPER_TARGET
    from ilnet.world import meshes, towns

    output = PAPER_INPUT.resize(*(size or PAPER_TARGET.shape))
    if scene in towns.NAMES:
        if at:
            raise click.UsageError("--at goes with a mesh; a town has its own waypoints")
        return evaluate.town_pairs(scene, scans or 8, output)
    mesh = Path(scene)
    if not mesh.exists():
        raise click.UsageError(f"--scene {scene} is neither a town ({', '.join(towns.NAMES)}) nor a mesh file")
    if at is None:
        raise click.UsageError("--scene MESH needs --at FILE, the positions of the sensor in the mesh")
    positions = [tuple(position) for position in meshes.read_positions(at).tolist()]
    if scans and scans > len(positions):
        raise click.UsageError(f"--scans is {scans}, but {at} holds {len(positions)} positions")
    return evaluate.mesh_pairs(mesh, positions[:scans], output)


def _evaluate_kitti(loaded: dict[str, Any], files: tuple[Path, ...], as_json: bool) -> None:
    from ilnet.learning import kitti

    results = kitti.judge(loaded, kitti.files(files))
    if as_json:
        click.echo(_json(results))
        return
    for kind, title in kitti.TITLES.items():
        click.echo(f"{title}\n{'method':18}{'MAE [m]':>11}{'IoU':>11}{'Chamfer':>11}")
        for result in results:
            found = result.get(kind, result)
            click.echo(f"{result['model']:18}" + "".join(f"{found[key]:11.3f}" for key in ("mae", "iou", "chamfer")))
        click.echo("")
    unseen = [f"{results[0][f'{kind} unmeasured']['unseen']:.0f} of {kind}" for kind in kitti.PROJECTIONS]
    click.echo(
        f"Means over {results[0]['scans']} file(s); --json has each. Of unmeasured rows, pixels that no ray went to "
        f"are left out: {' and '.join(unseen)} a file."
    )


def _intervals(results: list[dict[str, Any]]) -> list[str]:
    """Returns lines that tell how sure the figures are, and which model is ahead."""
    lines = ["95 % intervals over scans, and the difference from the first method, scan by scan:"]
    for result in results:
        low, high = result["iou_interval"]
        line = f"{result['model']:18} IoU {result['iou']:.3f} [{low:.3f}, {high:.3f}]"
        if "iou_difference" in result:
            less, more = result["iou_difference_interval"]
            line += f"   {result['iou_difference']:+.3f} [{less:+.3f}, {more:+.3f}]"
            line += "  ahead" if less > 0 else "  behind" if more < 0 else "  no clear difference"
        lines.append(line)
    return lines


def _json(value: Any) -> str:
    """Returns JSON, in which an undefined figure is null."""

    def defined(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: defined(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [defined(item) for item in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(defined(value))


@cli.command()
@click.argument("source", metavar="IN", type=Path)
@click.argument("out", metavar="OUT", type=Path)
@click.option("--size", type=_Size(), help="Rays to predict, over the same field of view.")
@click.option("--sensor", "--to", metavar="NAME|FILE", help="Preset or table to predict, instead of --size.")
@click.option("--model", "name", default="iln-surfaces", show_default=True, metavar="NAME|FILE")
@click.option(
    "--from",
    "origin",
    metavar="NAME|FILE",
    help="Preset or table with the angles of IN, if its files do not hold them.",
)
@click.option(
    "--columns",
    type=click.IntRange(3, 6),
    metavar="N",
    help="Columns of the points in .bin files; told by their values by default.",
)
@click.option("--topic", metavar="NAME", help="Topic of the clouds in a bag, where there are several.")
@click.option("--metadata", type=Path, metavar="FILE", help="Metadata (JSON) of the Ouster sensor of a capture.")
@click.option(
    "--precision",
    type=click.Choice(["float32", "bfloat16"]),
    default="float32",
    show_default=True,
    help="Of the network's layers, for a recording; bfloat16 is faster on processors that have it.",
)
@click.option(
    "--format",
    "suffix",
    type=click.Choice(["npz", "ply", "pcd", "laz", "bin"]),
    help="Format of the files in a folder OUT; npz by default.",
)
@click.option(
    "--min-confidence",
    type=float,
    metavar="P",
    help="Drop returns that are right to 10 cm with a probability below P, 0 to 1, by a model that tells it.",
)
@_max_memory
@click.pass_context
def upsample(
    context: click.Context,
    source: Path,
    out: Path,
    size: tuple[int, int] | None,
    sensor: str | None,
    name: str,
    origin: str | None,
    columns: int | None,
    topic: str | None,
    metadata: Path | None,
    precision: str,
    suffix: str | None,
    min_confidence: float | None,
) -> None:
    """Make a denser scan of the file IN, of each file in the folder IN, or of each scan in a bag or capture IN."""
    if bool(size) == bool(sensor):
        raise click.UsageError("give --size ROWSxCOLUMNS or --sensor NAME")
    from ilnet import models, sensor_files
    from ilnet.commands import recordings, upsample

    recording = recordings.is_recording(source)
    if suffix and not (source.is_dir() or recording):
        raise click.UsageError("--format goes with a folder; the suffix of OUT says the format of one file")
    if not recording and (topic or metadata or precision != "float32"):
        raise click.UsageError("--topic, --metadata and --precision go with a bag or a capture")
    target = size or sensor_files.named(str(sensor))
    measured = sensor_files.named(origin) if origin else None
    model, ending = models.load(name), f".{suffix or 'npz'}"
    if recording:
        dense = recordings.Densifier(model, target, precision, min_confidence)
        written, failed = recordings.run(source, out, dense, measured, topic, metadata, ending)
    else:
        written, failed = upsample.run(source, out, model, target, measured, ending, min_confidence, columns)
    if written:
        click.echo(f"{written} scan(s) written to {out}" + (f", {failed} could not be: see above" if failed else ""))
    if failed:
        context.exit(2)


@cli.command()
@click.argument("source", metavar="SOURCE")
@click.option("--size", type=_Size(), help="Rays to predict, over the same field of view.")
@click.option("--sensor", "--to", metavar="NAME|FILE", help="Preset or table to predict, instead of --size.")
@click.option("--model", "name", default="iln-surfaces", show_default=True, metavar="NAME|FILE")
@click.option(
    "--from", "origin", metavar="NAME|FILE", help="Preset or table of the sensor, if its packets do not tell it."
)
@click.option("--topic", metavar="NAME", help="Topic of the clouds in a bag, where there are several.")
@click.option("--metadata", type=Path, metavar="FILE", help="Metadata (JSON) of the sensor, if it is an Ouster.")
@click.option(
    "--precision",
    type=click.Choice(["float32", "bfloat16"]),
    default="float32",
    show_default=True,
    help="Of the network's layers; bfloat16 is faster on processors that have it.",
)
@click.option("--min-confidence", type=float, metavar="P", help="Drop returns that are less likely right to 10 cm.")
@click.option("--out", type=Path, metavar="PATH", help="Write to this bag, or folder of files; by default only show.")
@click.option("--port", type=click.IntRange(0, 65535), metavar="N", help="Show on this port; 8000 without --out.")
@click.option("--scans", type=click.IntRange(min=1), metavar="N", help="Stop after this many scans.")
def stream(
    source: str,
    size: tuple[int, int] | None,
    sensor: str | None,
    name: str,
    origin: str | None,
    topic: str | None,
    metadata: Path | None,
    precision: str,
    min_confidence: float | None,
    out: Path | None,
    port: int | None,
    scans: int | None,
) -> None:
    """Make the scans of SOURCE denser as they come: a port of this machine such as udp://:2368, a bag or a capture.

    Scans that come faster than the network runs are dropped and counted. Ctrl-C ends the stream and keeps the bag.
    """
    if bool(size) == bool(sensor):
        raise click.UsageError("give --size ROWSxCOLUMNS or --sensor NAME")
    from contextlib import ExitStack

    from ilnet import models, sensor_files
    from ilnet.commands import recordings, stream, viewer

    target = size or sensor_files.named(str(sensor))
    measured = sensor_files.named(origin) if origin else None
    dense = recordings.Densifier(models.load(name), target, precision, min_confidence)
    with ExitStack() as stack:
        deliver = []
        if port is not None or out is None:
            server = stack.enter_context(viewer.Server(8000 if port is None else port))
            click.echo(f"look at {server.address}", err=True)
            deliver.append(lambda frame, scan: stream.show(server, frame, scan))
        found = stream.run(source, deliver, dense, out, measured, topic, metadata, scans)
    click.echo(found)
    if found.problem:
        raise click.UsageError(found.problem)


@cli.command()
@click.argument("files", nargs=-1, required=True, type=Path)
@click.option("--from", "origin", metavar="NAME|FILE", help="Preset or table with the angles of files other than .npz.")
@click.option(
    "--out",
    type=Path,
    default=Path("view.html"),
    show_default=True,
    metavar="FILE",
    help="The page; a name that ends in .png makes a picture.",
)
def view(files: tuple[Path, ...], origin: str | None, out: Path) -> None:
    """Show a scan, a denser one, how it differs from the first or a third, and its confidence, as points to turn."""
    from ilnet import sensor_files
    from ilnet.commands import view
    from ilnet.scan_files import UnknownSensor

    try:
        view.run(files, out, sensor_files.named(origin) if origin else None)
    except ValueError as error:
        if isinstance(error.__cause__, UnknownSensor):
            raise click.UsageError(f"{error}: --from NAME") from error
        raise
    click.echo(f"{out}: open it in a browser" if out.suffix == ".html" else out)


@cli.command()
@click.option(
    "--towns", metavar="NAMES", help="Towns, comma separated, a seed after a colon: town01:7. All by default."
)
@click.option("--mesh", type=Path, metavar="FILE", help="Scan this mesh (metres, z up) instead of towns.")
@click.option("--at", type=Path, metavar="JSON", help='Sensor positions in the mesh [m]: {"positions": [[x, y, z]]}.')
@click.option("--scans", type=click.IntRange(min=1), required=True, metavar="N", help="Poses to scan from, in total.")
@click.option("--sizes", metavar="HxW", help=f"Sizes of the paper's sensor, comma separated; {_SIZES} by default.")
@click.option("--sensor", metavar="NAMES", help="Presets or tables, comma separated, instead of --sizes.")
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="NAME=VALUE",
    help="An effect, such as range_noise=0.02; may be repeated.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of waypoints, poses and traffic."
)
@click.option(
    "--shard",
    metavar="I/N",
    default="1/1",
    help="Simulate part I of N, on several hosts; merge the parts by copying files.",
)
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Processes on a CPU; one per core by default.")
@click.option("--out", type=Path, required=True, help="Folder of the archive; an interrupted run goes on there.")
@_max_memory
def simulate(
    towns: str | None,
    mesh: Path | None,
    at: Path | None,
    scans: int,
    sizes: str | None,
    sensor: str | None,
    effects: tuple[str, ...],
    seed: int,
    shard: str,
    workers: int | None,
    out: Path,
) -> None:
    """Simulate scans into a Zarr archive; if it is interrupted, the same command goes on."""
    if bool(mesh) != bool(at):
        raise click.UsageError("--mesh FILE and --at JSON go together")
    if mesh and towns:
        raise click.UsageError("--mesh and --towns exclude each other")
    if sizes and sensor:
        raise click.UsageError("--sizes and --sensor exclude each other")
    part, _, parts = shard.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise click.UsageError(f"--shard is {shard!r}; it should be I/N with 1 <= I <= N, such as 2/3")
    from ilnet import sensor_files
    from ilnet.commands import options
    from ilnet.data import generate
    from ilnet.world.towns import NAMES

    if mesh and at:
        places = generate.mesh_place(mesh, at)
    else:
        places = generate.town_places(options.towns(towns or ",".join(NAMES)))
    sensors = [sensor_files.named(name) for name in sensor.split(",")] if sensor else options.sensors(sizes or _SIZES)
    wanted = options.effects(effects)
    try:
        archive = generate.generate(out, places, scans, sensors, seed, (int(part), int(parts)), workers, wanted)
    except KeyboardInterrupt:
        click.echo(f"interrupted: finished units stay in {out}; the same command goes on from there", err=True)
        raise
    left = len(archive.missing())
    state = f"{left} units of {generate.UNIT} scans are left for other shards" if left else "complete"
    click.echo(f"{out}: {scans} scans of {', '.join(archive.sizes)}: {state}")


@cli.command()
@click.argument("sections", nargs=-1, type=click.Choice(["ops", "frame", "train", "rays"]))
@click.option("--json", "as_json", is_flag=True, help="Print a JSON list instead of the table.")
def bench(sections: tuple[str, ...], as_json: bool) -> None:
    """Time our ops, frames, training steps and rays beside the usual ways to write them; by default all of them."""
    from ilnet.commands import bench

    rows = bench.run(sections)
    click.echo(json.dumps([row.json() for row in rows], indent=1) if as_json else bench.table(rows))


@cli.command()
@click.option(
    "--scan",
    "scans",
    type=Path,
    multiple=True,
    metavar="FILE",
    help="A measured scan that holds its angles; may be repeated.",
)
@click.option(
    "--mesh", "meshes", type=Path, multiple=True, metavar="FILE", help="A mesh (metres, z up); may be repeated."
)
@click.option("--at", type=Path, multiple=True, metavar="JSON", help="Positions in the mesh: one file for each --mesh.")
@click.option("--town", "towns", multiple=True, metavar="NAME", help="A town, or `all`; may be repeated.")
@click.option("--out", type=Path, default=Path("survey_output"), show_default=True, help="Folder for the figure.")
@click.option("--json", "as_json", is_flag=True, help="Print a JSON list instead of the table.")
@_max_memory
def survey(
    scans: tuple[Path, ...],
    meshes: tuple[Path, ...],
    at: tuple[Path, ...],
    towns: tuple[str, ...],
    out: Path,
    as_json: bool,
) -> None:
    """Compare towns and meshes with measured scans, all seen with the rays of each scan: a table and a figure."""
    if len(meshes) != len(at):
        raise click.UsageError("--mesh FILE and --at JSON go together, one each")
    if not (scans or meshes or towns):
        raise click.UsageError("give at least one --scan, --mesh or --town")
    from ilnet.commands import survey
    from ilnet.world.towns import NAMES

    entries = survey.compare(scans, zip(meshes, at, strict=True), NAMES if towns == ("all",) else towns)
    found = "[\n" + ",\n".join(map(json.dumps, survey.records(entries))) + "\n]"
    survey.draw(entries, out / "survey.png")
    (out / "survey.json").write_text(found + "\n")
    click.echo(found if as_json else f"{survey.table(entries)}\n\nfigure and numbers: {out}/survey.png, survey.json")


@cli.command()
@click.option("--town", "names", multiple=True, metavar="NAME", help="A town to draw; may be repeated. All by default.")
@click.option("--out", type=Path, default=Path("towns_output"), show_default=True, help="Folder for the pictures.")
def towns(names: tuple[str, ...], out: Path) -> None:
    """Draw the procedural towns: from above, from the street, and one scan of each."""
    from ilnet.commands import pictures
    from ilnet.world.towns import NAMES

    for path in pictures.draw(list(names or NAMES), out):
        click.echo(path)


@cli.command()
@click.argument("names", nargs=-1, type=click.Choice(_EXPERIMENTS))
@click.option(
    "--preset",
    help="Preset of each training. By default small; all that train nothing use the networks that ship.",
)
@click.option(
    "--out",
    type=Path,
    default=Path("runs/experiments"),
    show_default=True,
    help="Folder for weights, numbers and figures.",
)
@click.option(
    "--scans", type=click.IntRange(min=1), help="Scans from each test town, 20 by default; of a tree, all by default."
)
@click.option(
    "--seeds", type=click.IntRange(min=1), default=3, show_default=True, help="Trainings for each band of a curve."
)
@click.option(
    "--data",
    type=Path,
    metavar="DIR",
    help="Stored images: for LiDAR-SR, and to compare with continuous rays. On a tree of .rimg files, table measures.",
)
@click.option(
    "--model",
    "models",
    multiple=True,
    metavar="NAME|FILE",
    help="A model for the table of a tree; may be repeated. By default the rules and the networks that ship.",
)
@click.option(
    "--measured",
    type=Path,
    multiple=True,
    metavar="FILE|FOLDER",
    help="A measured scan, or all those in a folder; may be repeated.",
)
@_max_memory
def experiment(
    names: tuple[str, ...],
    preset: str | None,
    out: Path,
    scans: int | None,
    seeds: int,
    data: Path | None,
    models: tuple[str, ...],
    measured: tuple[Path, ...],
) -> None:
    """Run the paper's experiments and ours: CSV, figures, RESULTS.md. An interrupted run goes on where it stopped."""
    if not names:
        raise click.UsageError("name some experiments, or all")
    from ilnet import scan_files
    from ilnet.commands import experiment, odometry
    from ilnet.commands.study import Study

    chosen = tuple(experiment.EXPERIMENTS) if "all" in names else names
    needs = {"rays": ("--data DIR", data)} | dict.fromkeys(("real", "alignment"), ("--measured FILE", measured))
    for name, (option, value) in needs.items():
        if name in chosen and not value:  # said before hours of training, not after
            raise click.UsageError(f"{name} needs {option}")
    if "odometry" in chosen:
        odometry.check_installed()
    files = tuple(path for named in measured for path in scan_files.listed(named))
    study = Study(preset, out, scans or 20, seeds, data, files, models, scans)
    for name in chosen:
        study.run(name, experiment.EXPERIMENTS[name])
        click.echo(experiment.results(study))


@cli.group(name="sensor")
def sensor_group() -> None:
    """List sensors, show one, or find the one that measured some points."""


@sensor_group.command(name="list")
def sensor_list() -> None:
    """List the presets: rows, columns, elevations, ranges, and where the numbers stand."""
    from ilnet.commands import sensors

    click.echo(sensors.listing())


@sensor_group.command(name="show")
@click.argument("name", metavar="NAME|FILE")
@click.option("--out", type=Path, metavar="FILE", help="Draw its rows into this picture.")
@click.option("--json", "as_json", is_flag=True, help="Print the table as a file of --sensor holds it.")
def sensor_show(name: str, out: Path | None, as_json: bool) -> None:
    """Show the rows of a preset, or of a table in a .json or .npz file."""
    from ilnet import sensor_files
    from ilnet.commands import sensors

    shown = sensor_files.named(name)
    click.echo(json.dumps(shown.table()) if as_json else sensors.angles(shown))
    if out:
        sensors.draw(shown, out)


@sensor_group.command(name="estimate")
@click.argument("files", nargs=-1, type=Path, required=True)
@click.option("--out", type=Path, metavar="FILE", help="Write the table (.json or .npz), which --sensor FILE takes.")
@click.option("--picture", type=Path, metavar="FILE", help="Draw the points by elevation, and the rows.")
def sensor_estimate(files: tuple[Path, ...], out: Path | None, picture: Path | None) -> None:
    """Find the rows and columns of the one sensor that measured the points in FILES.

    By the rings of the points where all files have them, else by their elevations. Rows without any return cannot be
    found: several files show more of them.
    """
    from ilnet import sensor_files
    from ilnet.commands import sensors

    if out:
        sensor_files.check_suffix(out)
    found, clouds = sensors.estimate(files)
    click.echo(sensors.summary(found))
    if out:
        sensor_files.write(out, found.sensor)
        click.echo(f"table: {out}")
    else:
        click.echo(sensors.angles(found.sensor))
    if picture:
        sensors.draw_fit(found, clouds, picture)
        click.echo(f"picture: {picture}")


def _scan_pair(scan: Path, rows: int | None, sensor: str | None) -> tuple[Any, Any]:
    """Returns what `evaluate.scan_pair` does; if the file lacks its sensor, the error names the option."""
    from ilnet.learning import evaluate
    from ilnet.scan_files import UnknownSensor

    try:
        return evaluate.scan_pair(scan, 16 if rows is None else rows, sensor)
    except ValueError as error:
        if isinstance(error.__cause__, UnknownSensor):
            raise click.UsageError(f"{error}: --sensor NAME") from error
        raise


def _table(methods: dict[str, dict[str, Any]]) -> str:
    columns = {
        "mae": "MAE [m]",
        "iou": "IoU",
        "precision": "precision",
        "recall": "recall",
        "f1": "F1",
        "floating": "floating",
        "edge_mae": "at edges",
    }
    columns |= {"chamfer": "Chamfer"} if all("chamfer" in figures for figures in methods.values()) else {}
    width = max(18, *map(len, methods))
    lines = [f"{'method':{width}}" + "".join(f"{title:>11}" for title in columns.values())]
    lines += [f"{name:{width}}" + "".join(f"{figures[c]:11.3f}" for c in columns) for name, figures in methods.items()]
    return "\n".join(lines)


def main() -> None:
    """Runs the command line; an error that a user can fix is one line on stderr and exit code 2."""
    # By default torch's threads stay awake for milliseconds after each operation, on cores that the next kernel needs.
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")
    try:
        sys.exit(cli.main(prog_name="python -m ilnet", standalone_mode=False))
    except click.ClickException as error:
        message = error.format_message()
    except (click.Abort, KeyboardInterrupt):
        sys.exit(130)
    except (ValueError, OSError, MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not memory.ran_out(error):
            raise
        from ilnet.commands import options

        message = options.error_line(error)
    click.echo("error: " + " ".join(message.split()), err=True)
    sys.exit(2)
