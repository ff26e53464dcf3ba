import csv
import math
import shutil
import types
from pathlib import Path

import pytest
import torch

from ilnet import data, models, scan_files
from ilnet.commands import cli, evidence, experiment, fair, variants
from ilnet.commands.study import Study, made_with, spans
from ilnet.learning import evaluate, metrics, train
from ilnet.sensor import PAPER_INPUT, preset
from ilnet.world import simulate
from ilnet.world.simulate import pose


@pytest.fixture
def study(tmp_path, monkeypatch, yard, quiet_place):
    """Experiments in the yard, with networks and budgets of a size for tests."""
    place = quiet_place([[3, 0, 0]])

    def pairs(town, count, output, source=PAPER_INPUT):
        return [tuple(simulate.scan(yard, sensor, pose((3.0, 0.0, 1.8))) for sensor in (source, output))] * count

    monkeypatch.setattr(simulate, "best_device", lambda: torch.device("cpu"))  # where the yard is
    monkeypatch.setattr(train.places, "town", lambda *args: place)
    monkeypatch.setattr(evaluate, "town_pairs", pairs)
    monkeypatch.setattr(train, "HELD_OUT", {"town01": 1})
    monkeypatch.setattr(train, "HELD_OUT_SCANS", 1)
    monkeypatch.setattr(train, "VALIDATION", PAPER_INPUT)  # a quarter of the work of each validation
    monkeypatch.setattr(train, "VALIDATE_EVERY", (2, 2))
    monkeypatch.setattr(Study, "sizes", ((16, 256), (32, 512)))
    tables = experiment.PAPER["64x1024"], experiment.PAPER["128x2048"]
    monkeypatch.setattr(experiment, "PAPER", dict(zip(("16x256", "32x512"), tables, strict=True)))
    monkeypatch.setattr(experiment.plot, "point_clouds", lambda scans, path, reach: path.write_bytes(b"drawn"))
    size = train.Preset(steps=4, blocks=1, crops=2, columns=32, queries=64, towns=("town01",))
    monkeypatch.setitem(train.PRESETS, "tiny", size)
    return Study("tiny", tmp_path / "out", scans=1, seeds=2)


def rows(study, name):
    with open(study.out / f"{name}.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_the_table_has_every_method_at_every_size_beside_the_paper(study):
    experiment.table(study)
    found = rows(study, "table")
    assert [(row["size"], row["model"]) for row in found] == [
        (size, name)
        for size in ("16x256", "32x512")
        for name in ("nearest", "bilinear", "bilinear-inverse", "planes", "liif", "iln", "iln-surfaces")
    ]
    assert all(0 < float(row["iou"]) <= 1 for row in found if row["model"] != "liif")
    assert {path.name for path in study.out.glob("*.png")} == {"table.png", "points-town07.png", "points-town10.png"}
    page = experiment.results(study).read_text()
    assert "| liif | 16x256 | 2 |" in page
    assert "| 1.558 | 0.258 |" in page  # what the paper reports for LIIF at 64x1024


def test_what_was_trained_is_not_trained_again(study, monkeypatch):
    file = study.trained("iln-0", "iln")
    before = file.read_bytes()
    monkeypatch.setattr(train, "train", lambda *args, **kwargs: pytest.fail("trained again"))
    assert study.trained("iln-0", "iln") == file
    assert file.read_bytes() == before


def test_convergence_follows_test_figures_over_seeds(study):
    experiment.convergence(study)
    found = rows(study, "convergence")
    assert {(row["model"], row["seed"], row["step"]) for row in found} == {
        (name, seed, step) for name in ("liif", "iln", "iln-surfaces") for seed in "01" for step in "24"
    }
    assert all(float(row["seconds"]) > 0 for row in found)
    page = experiment.results(study).read_text()
    assert "| steps of liif to the IoU" in page
    ends = [row for row in found if row["step"] == "4"]
    assert all(f"| {row['model']} | {row['seed']} | 4 | {row['seconds']} |" in page for row in ends)
    assert "| iln | 0 | 2 |" not in page


def test_the_seconds_of_a_curve_are_of_the_median_pace(tmp_path):
    log = tmp_path / "from-step-0" / "metrics.csv"
    log.parent.mkdir()
    lines = ["step,seconds,test/mae,test/iou,test/floating"]
    lines += [f"{step},{seconds},2.0,0.3,0.1" for step, seconds in ((99, 10), (199, 20), (299, 5000), (399, 5010))]
    log.write_text("\n".join(lines) + "\n")  # halted for more than an hour between 200 and 300
    assert [row["seconds"] for row in experiment._probed(tmp_path)] == pytest.approx([10, 20, 30, 40])


def test_steps_to_reach_by_hand():
    curves = {"iln": {10: 0.30, 50: 0.40, 100: 0.41}, "liif": {10: 0.10, 50: 0.29, 100: 0.33}}
    made = [
        {"model": name, "step": step, "iou": iou + shift}
        for name, curve in curves.items()
        for step, iou in curve.items()
        for shift in (-0.01, 0.01)
    ]
    reached = experiment.steps_to_reach(made)
    assert reached == {"iou": pytest.approx(0.30), "iln_steps": 10, "liif_steps": 100, "ratio": 10}
    never = [{**row, "iou": row["iou"] / 2} if row["model"] == "liif" else row for row in made]
    assert math.isinf(experiment.steps_to_reach(never)["ratio"])


def test_ablations_and_measured_scans(study, tmp_path, yard):
    from ilnet import scan_files

    frame = tmp_path / "frame.npz"
    scan_files.write(frame, simulate.scan(yard, preset("os1-32").resize(32, 256), pose((3.0, 0.0, 1.8))))
    study = Study("tiny", study.out, 1, 1, measured=(frame,))
    for name in ("attention", "real"):
        experiment.EXPERIMENTS[name](study)
        assert (study.out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    assert [row["depth"] for row in rows(study, "attention")[::2]] == ["0", "1", "2", "4"]
    assert {row["beams"] for row in rows(study, "real")} == {"8", "16"}
    assert set(metrics.FIGURES[:5]) < set(rows(study, "real")[0])


def test_without_a_preset_the_networks_that_ship_are_compared(study, monkeypatch):
    study = Study(None, study.out)
    assert study.networks() == {name: name for name in ("liif", "iln", "iln-surfaces")}
    trained = []
    monkeypatch.setattr(train, "train", lambda name, preset_name, *args, **kwargs: trained.append((name, preset_name)))
    study.trained("iln-0", "iln")
    assert trained == [("iln", "small")]


def test_lidar_sr_has_a_network_for_each_size_that_is_stored(study, tmp_path, monkeypatch):
    asked, drawn = [], []
    archive = tmp_path / "stored"
    sensors = {size: preset(f"paper-{size}") for size in ("16x1024", "64x1024")}
    data.Archive.create(archive, 1, sensors, {"towns": ["nowhere"]})

    def fake(name, preset_name, folder, archive=None, target=None, **options):
        asked.append((folder.name, name, archive, target))
        models.save(models.create("bilinear"), folder / f"{name}.safetensors", "bilinear", {}, steps=7, minutes=1.5)

    monkeypatch.setattr(train, "train", fake)
    monkeypatch.setattr(Study, "sizes", ((32, 512), (64, 1024)))
    monkeypatch.setattr(experiment, "PAPER", dict.fromkeys(("32x512", "64x1024"), experiment.PAPER["32x512"]))
    monkeypatch.setattr(experiment.plot, "point_clouds", lambda scans, path, reach: drawn.append(list(scans)))
    experiment.table(Study("tiny", study.out, 1, 1, archive=archive))
    assert asked[3:] == [("lidar-sr-64", "lidar-sr", archive, (64, 1024))]
    [row] = [row for row in rows(study, "table") if row["model"] == "lidar-sr"]
    assert (row["size"], row["steps"], row["minutes"]) == ("64x1024", "7", "1.5")
    assert all("lidar-sr" in captions for captions in drawn)
    assert "LiDAR-SR trained with preset tiny." in experiment.results(study).read_text()


def test_every_part_of_surfaces_is_taken_away_once_and_beside_them_stands_an_oracle(study, monkeypatch):
    study = Study("tiny", study.out, 1, seeds=1)
    monkeypatch.setattr(variants, "SIZE", {"features": 8, "blocks": 1, "tokens": 8, "heads": 2})
    evidence.surfaces(study)
    found = rows(study, "surfaces")
    names = "surfaces", "mean", "ranges", "L1", "one channel", "any sensor"
    trained = [(row["variant"], row["size"]) for row in found if row["seed"] == "0"]
    assert sorted(trained) == sorted((name, size) for name in names for size in ("16x256", "32x512"))
    oracle = {row["variant"]: float(row["iou"]) for row in found if not row["seed"] and row["size"] == "32x512"}
    assert oracle["oracle: best of 4 ranges"] < oracle["oracle: best of 36 surfaces"]
    assert len(list((study.out / "weights").iterdir())) == 5  # the mean is another answer of the same weights
    assert (study.out / "surfaces.png").read_bytes()[:4] == b"\x89PNG"
    page = experiment.results(study).read_text()
    assert "| IoU of surfaces over that of its variant ranges, 16x256 |" in page
    assert "| oracle: best of 36 surfaces | 32x512 |" in page


def test_means_and_spans_by_hand():
    seeds = [{"variant": "L1", "size": "64x1024", "iou": str(v), "mae": "2", "floating": "0.1"} for v in (0.3, 0.5)]
    assert evidence.means(seeds) == {("L1", "64x1024"): {"iou": pytest.approx(0.4), "mae": 2.0, "floating": 0.1}}
    assert spans(seeds, evidence.VARIANT_KEYS)[0]["iou"] == "0.400 (0.300 to 0.500)"
    assert spans(seeds[:1], evidence.VARIANT_KEYS)[0]["iou"] == "0.300"


def test_confidence_and_other_sensors(study, monkeypatch):
    monkeypatch.setattr(train, "HELD_OUT_SENSORS", ("os1-32",))
    monkeypatch.setattr(train, "VALIDATION", PAPER_INPUT.resize(32, 256))
    monkeypatch.setattr(evidence, "_SENSORS", (preset("vlp-16"), preset("paper-16x1024")))
    file = study.out / "small.safetensors"
    arguments = {"features": 8, "blocks": 1, "tokens": 8, "heads": 2}
    models.save(models.create("iln-surfaces", **arguments), file, "iln-surfaces", arguments)
    monkeypatch.setattr(Study, "networks", lambda self: {"liif": "bilinear", "iln": "nearest", "iln-surfaces": file})
    for name in ("confidence", "sensors"):
        experiment.EXPERIMENTS[name](study)
        assert (study.out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    found = rows(study, "confidence")
    assert [(row["sensor"], row["size"]) for row in found] == [("paper", "32x256"), ("os1-32", "32x1024")]
    for row in found:
        assert 0 <= float(row["calibration error"]) < 1
        assert float(row["recall of the rest"]) <= float(row["recall"])
    found = rows(study, "sensors")
    assert [(row["sensor"], row["beams"], row["model"]) for row in found] == [
        (sensor, "8", model) for sensor in ("vlp-16", "paper-16x1024") for model in ("planes", "iln", "iln-surfaces")
    ]
    assert (
        "| MAE of iln-surfaces over planes, paper-16x1024, 8 beams -> 16x1024 |"
        in experiment.results(study).read_text()
    )


def test_the_command_knows_every_experiment(study):
    assert (*experiment.EXPERIMENTS, "all") == cli._EXPERIMENTS


def test_ratios_by_hand():
    def row(model, iou, mae, **more):
        return {"model": model, "size": "128x2048", "iou": str(iou), "mae": str(mae), **more}

    table = [row("liif", 0.2, 2.0), row("bilinear", 0.1, 4.0), row("iln", 0.3, 1.0), row("iln-surfaces", 0.36, 1.0)]
    real = [row(name, iou, 1.0, scan="street", beams="32") for name, iou in (("planes", 0.2), ("iln-surfaces", 0.25))]
    curves = [{"model": name, "step": "10", "iou": str(iou)} for name, iou in (("iln", 0.3), ("liif", 0.2))]
    found = {row["figure"]: row for row in experiment.ratios({"table": table, "real": real, "convergence": curves})}
    assert found["IoU of iln over liif, 128x2048"] == {
        "figure": "IoU of iln over liif, 128x2048",
        "the paper": "1.40",  # 0.331 / 0.236
        "ours": "1.50",
    }
    assert found["MAE of iln over liif, 128x2048"]["ours"] == "0.50"
    assert found["IoU of iln-surfaces over iln, 128x2048"] == {
        "figure": "IoU of iln-surfaces over iln, 128x2048",
        "the paper": "",
        "ours": "1.20",
    }
    assert found["IoU of iln-surfaces over planes, street, 32 beams -> 128x2048"]["ours"] == "1.25"
    [steps] = [row["ours"] for figure, row in found.items() if figure.startswith("steps of liif")]
    assert steps == "never in its budget"
    assert experiment.ratios({}) == []


def test_what_is_missing_is_named(study):
    with pytest.raises(ValueError, match=r"stored images are missing.*--data DIR"):
        experiment.rays(study)
    with pytest.raises(ValueError, match=r"no measured scans are named.*--measured FILE"):
        experiment.real(study)


def test_two_measured_files_of_one_name_are_refused_before_any_training(tmp_path, command):
    files = [tmp_path / folder / "frame.npz" for folder in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        file.touch()
    with pytest.raises(ValueError, match=r"measured holds .*a/frame.npz and .*b/frame.npz; their names should differ"):
        Study(None, tmp_path, measured=tuple(files))
    code, out, [error] = command("experiment", "convergence", "real", "--measured", files[0], "--measured", files[1])
    assert (code, out) == (2, "")
    assert "their names should differ" in error


def test_networks_go_where_the_scans_are(tmp_path, monkeypatch):
    """Scans of towns are on a GPU where there is one; a device without numbers stands in for it."""
    scan = types.SimpleNamespace(ranges=torch.empty(0, device="meta"), sensor=preset("paper-16x1024"))
    model, seen = models.create("iln", features=16, blocks=1, heads=4), []

    def devices(*_, **options):
        seen.append((model.head[1].weight.device.type, str(options.get("device", "meta"))))
        return types.SimpleNamespace(ranges=lambda scan: torch.zeros(1))

    monkeypatch.setattr(evaluate, "town_pairs", lambda *_: [(scan, scan)])
    monkeypatch.setattr(models, "Upsampler", devices)
    monkeypatch.setattr(models, "load", lambda file: model)
    monkeypatch.setattr(model, "upsample", devices)
    monkeypatch.setattr(experiment.plot, "point_clouds", lambda *_, **options: None)
    experiment._frame_time(model)
    model.to_empty(device="cpu")
    experiment._draw_points(Study(None, tmp_path), (64, 1024), {"iln": "iln"})
    assert set(seen) == {("meta", "meta")}


def test_the_page_that_ships_is_the_one_that_its_numbers_make(tmp_path):
    shipped = Path(experiment.__file__).parents[1] / "results"
    for file in (shipped / "about.json", *shipped.glob("*.csv")):
        shutil.copy(file, tmp_path)
    page = experiment.results(Study(None, tmp_path))
    assert page.read_text() == (shipped / "RESULTS.md").read_text()


def test_values_corrections_and_weights_are_compared_with_all_else_equal(study, monkeypatch):
    monkeypatch.setattr(fair, "REHEARSAL", 2)
    monkeypatch.setattr(fair, "_TRAINING", {**fair._TRAINING, "steps": 2})
    small = {"features": 16, "blocks": 1}
    monkeypatch.setattr(fair, "_SIZE", {"MLP": {**small, "hidden": 16}, "attention": small, fair.CONTROL: small})
    alone = Study(study.preset, study.out, scans=1, seeds=1)
    alone.run("fair", fair.fair)
    about = made_with(alone.out)["fair"]
    assert about["command"] == "python -m ilnet experiment fair --scans 1 --seeds 1 --preset tiny"
    assert len(about["commit"]) >= 7
    assert about["training_minutes"] >= 0
    found = rows(alone, "fair")
    cases = {(row["kind"], row["decoder"], row["start"]) for row in found}
    assert len(cases) == 3 * 2 * 2 + 2
    assert len(found) == len(cases) * len(study.sizes)
    assert len({row["mae"] for row in found if row["size"] == "16x256"}) > 6
    assert (study.out / "fair.png").read_bytes()[:4] == b"\x89PNG"
    assert "## fair" in experiment.results(alone).read_text()


def test_wrong_angles_cost_every_model(study, tmp_path, yard, monkeypatch):
    sensor = preset("os1-64").resize(32, 256)
    scan = simulate.scan(yard, sensor, pose((3.0, 0.0, 1.8)))
    scan_files.write(tmp_path / "frame.npz", scan)
    measured = Study(None, study.out, measured=(tmp_path / "frame.npz",))
    fair.alignment(measured)
    found = {(row["model"], row["queries"]): float(row["iou"]) for row in rows(measured, "alignment")}
    assert {model for model, _ in found} == {"planes", "iln", "iln-surfaces"}
    assert all(found[model, "right"] > 1.5 * found[model, "wrong"] for model, _ in found)
    assert (study.out / "alignment.png").read_bytes()[:4] == b"\x89PNG"
