"""The command line: `python -m ilnet COMMAND`."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import click

__all__ = ["main"]


class _Size(click.ParamType):
    """Rows and columns of a range image."""

    name = "ROWSxCOLUMNS"

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> tuple[int, int]:
        """Returns both numbers."""
        rows, _, columns = str(value).partition("x")
        if not (rows.isdecimal() and columns.isdecimal() and int(rows) >= 2 and int(columns) >= 2):
            self.fail(f"{value!r} should be rows x columns, at least 2 of each, such as 128x2048", parameter, context)
        return int(rows), int(columns)


# The commands import what they need themselves, so that `--help` and a typing error answer at once.


@click.group(context_settings={"help_option_names": ["-h", "--help"]}, invoke_without_command=True)
@click.pass_context
def cli(context: click.Context) -> None:
    """Implicit LiDAR Network: dense range images from sparse ones."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@cli.command()
@click.option("--mesh", type=Path, metavar="FILE", help="Scan this mesh (metres, z up) instead of the town.")
@click.option("--at", type=(float, float, float), metavar="X Y Z", help="Position of the sensor in the mesh [m].")
@click.option("--scan", type=Path, metavar="FILE", help="Decimate this scan, and judge against all of its rows.")
@click.option("--rows", type=int, metavar="N", help="Beams of the scan to keep; 16 unless told.")
@click.option("--sensor", metavar="NAME", help="Preset with the scan's angles, where the file does not name them.")
@click.option("--out", type=Path, default=Path("demo_output"), show_default=True, help="Folder for the pictures.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of the table.")
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
    from ilnet import demo as demonstration
    from ilnet import evaluate

    if mesh and at:
        [pair], source = evaluate.mesh_pairs(mesh, [at], demonstration.OUTPUT), mesh.name
    elif scan:
        pair, source = evaluate.scan_pair(scan, 16 if rows is None else rows, sensor), scan.name
    else:
        pair, source = demonstration.from_town(), demonstration.TOWN
    result = demonstration.demo(*pair, out, source)
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
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of weights and rays.")
@click.option("--out", type=Path, default=Path("runs"), show_default=True, help="Folder for weights, figures, logs.")
def train(model: str, preset: str, steps: int | None, seed: int, out: Path) -> None:
    """Train MODEL on rays cast at continuous directions; goes on where an interrupted run in --out stopped."""
    from ilnet import train as training

    figures = training.train(model, preset, out, steps, seed)
    click.echo(f"{out / model}.safetensors: " + ", ".join(f"{name} {value:.3f}" for name, value in figures.items()))


@cli.command("evaluate")
@click.option("--model", "names", multiple=True, required=True, metavar="NAME|FILE", help="May be given repeatedly.")
@click.option("--scene", metavar="TOWN|MESH", help="Scan this town, or this mesh file (metres, z up).")
@click.option("--at", type=Path, metavar="FILE", help='Positions in the mesh: {"positions": [[x, y, z], ...]} [m].')
@click.option("--scan", type=Path, metavar="FILE", help="Decimate this scan, and judge against all of its rows.")
@click.option("--rows", type=int, metavar="N", help="Beams of the scan to keep; 16 unless told.")
@click.option("--sensor", metavar="NAME", help="Preset with the scan's angles, where the file does not name them.")
@click.option("--size", type=_Size(), help="Rays to predict in the scene; 128x2048 unless told.")
@click.option("--scans", type=click.IntRange(min=1), help="Scans of the scene; 8, or all positions, unless told.")
@click.option(
    "--json", "as_json", is_flag=True, help="Print an object instead of the table, or a list for many models."
)
def evaluate_(
    names: tuple[str, ...],
    scene: str | None,
    at: Path | None,
    scan: Path | None,
    rows: int | None,
    sensor: str | None,
    size: tuple[int, int] | None,
    scans: int | None,
    as_json: bool,
) -> None:
    """Measure models on scans of a scene, seen with 16x1024 rays, or on a measured scan."""
    if bool(scene) == bool(scan):
        raise click.UsageError("give --scene TOWN|MESH or --scan FILE")
    if scan and (at or size or scans):
        raise click.UsageError("--at, --size and --scans go with --scene; a scan is judged at its own size")
    if scene and (rows is not None or sensor is not None):
        raise click.UsageError("--rows and --sensor go with --scan FILE")
    from ilnet import evaluate, models, towns

    loaded = {name: models.load(name) for name in names}
    output = evaluate.INPUT.resize(*(size or (128, 2048)))
    if scan:
        pairs = [evaluate.scan_pair(scan, 16 if rows is None else rows, sensor)]
    elif scene in towns.NAMES:
        if at:
            raise click.UsageError("--at goes with a mesh; a town has its own waypoints")
        pairs = evaluate.town_pairs(scene, scans or 8, output)
    else:
        mesh = Path(str(scene))
        if not mesh.exists():
            raise click.UsageError(f"--scene {scene} is neither a town ({', '.join(towns.NAMES)}) nor a mesh file")
        if at is None:
            raise click.UsageError("--scene MESH needs --at FILE, the positions of the sensor in the mesh")
        positions = evaluate.read_positions(at)
        if scans and scans > len(positions):
            raise click.UsageError(f"--scans is {scans}, but {at} holds {len(positions)} positions")
        pairs = evaluate.mesh_pairs(mesh, positions[:scans], output)
    results = evaluate.evaluate(loaded, pairs)
    if as_json:
        click.echo(json.dumps(results[0] if len(results) == 1 else results))
        return
    click.echo(f"{scene or scan}: {len(pairs)} scan(s) -> {results[0]['size']}\n")
    click.echo(_table({result["model"]: result for result in results}))


@cli.command("upsample")
@click.argument("source", metavar="IN", type=Path)
@click.argument("out", metavar="OUT", type=Path)
@click.option("--size", type=_Size(), help="Rays wanted over the same field of view.")
@click.option("--sensor", metavar="NAME", help="Or the preset whose scan is wanted.")
@click.option("--model", "name", default="iln-prior", show_default=True, metavar="NAME|FILE")
@click.option(
    "--from", "origin", metavar="NAME", help="Preset with the angles of IN, where its files do not name them."
)
@click.option("--format", "suffix", type=click.Choice(["npz", "ply", "pcd"]), help="In a folder OUT; npz unless told.")
@click.pass_context
def upsample_(
    context: click.Context,
    source: Path,
    out: Path,
    size: tuple[int, int] | None,
    sensor: str | None,
    name: str,
    origin: str | None,
    suffix: str | None,
) -> None:
    """Make a denser scan of the file IN, or of each file in the folder IN."""
    if bool(size) == bool(sensor):
        raise click.UsageError("give --size ROWSxCOLUMNS or --sensor NAME")
    if suffix and not source.is_dir():
        raise click.UsageError("--format goes with a folder; the suffix of OUT says the format of one file")
    from ilnet import models, upsample
    from ilnet.sensor import preset

    target = size or preset(str(sensor))
    written, failed = upsample.upsample(
        source, out, models.load(name), target, preset(origin) if origin else None, f".{suffix or 'npz'}"
    )
    if written:
        click.echo(f"{written} scan(s) written to {out}" + (f", {failed} could not be: see above" if failed else ""))
    if failed:
        context.exit(2)


@cli.command()
@click.argument("sections", nargs=-1, type=click.Choice(["ops", "frame", "train", "rays"]))
@click.option("--json", "as_json", is_flag=True, help="Print a JSON list instead of the table.")
def bench(sections: tuple[str, ...], as_json: bool) -> None:
    """Time our ops, frames, training steps and rays beside what one would otherwise write; all unless told."""
    from ilnet import bench as benchmarks

    rows = benchmarks.bench(sections)
    click.echo(json.dumps([row.json() for row in rows], indent=1) if as_json else benchmarks.table(rows))


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
    width = max(18, *map(len, methods))
    lines = [f"{'method':{width}}" + "".join(f"{title:>11}" for title in columns.values())]
    lines += [f"{name:{width}}" + "".join(f"{figures[c]:11.3f}" for c in columns) for name, figures in methods.items()]
    return "\n".join(lines)


def main() -> None:
    """Runs the command line; what a user can mend is one line on stderr and exit code 2."""
    # Torch's threads would stay awake for milliseconds after each operation, on cores that the next kernel wants.
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")
    try:
        sys.exit(cli.main(prog_name="python -m ilnet", standalone_mode=False))
    except click.ClickException as error:
        message = error.format_message()
    except (click.Abort, KeyboardInterrupt):
        sys.exit(130)
    except (ValueError, OSError) as error:
        message = str(error)
    click.echo("error: " + " ".join(message.split()), err=True)
    sys.exit(2)
