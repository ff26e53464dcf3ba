import csv
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch.utils.data import get_worker_info

from ilnet import data, models
from ilnet.learning import metrics, train
from ilnet.sensor import PAPER_INPUT, Sensor, preset
from ilnet.world import places, simulate
from ilnet.world.simulate import pose


@pytest.fixture
def quick(monkeypatch, quiet_place):
    """Training in the yard, with a network and batches of a size for tests."""
    place = quiet_place([[3, 0, 0]])
    monkeypatch.setattr(simulate, "best_device", lambda: torch.device("cpu"))  # where the yard is
    monkeypatch.setattr(train.places, "town", lambda *args: place)
    monkeypatch.setattr(train, "HELD_OUT", {"town01": 1})
    monkeypatch.setattr(train, "HELD_OUT_SCANS", 1)
    size = train.Preset(blocks=1, steps=4, crops=2, columns=32, queries=64, towns=("town01",))
    monkeypatch.setitem(train.PRESETS, "tiny", size)
    monkeypatch.setattr(train, "HELD_OUT_SENSORS", ("os1-32",))

    def run(out, name="iln", **options):
        return train.train(name, "tiny", out, **{"features": 16, "heads": 4, **options})

    return run


def test_writes_weights_that_load_and_figures(tmp_path, quick):
    figures = quick(tmp_path)
    assert set(figures) == {f"val/{name}" for name in metrics.FIGURES}
    model = models.load(tmp_path / "iln.safetensors")
    assert isinstance(model, models.ILN)
    with open(tmp_path / "iln" / "from-step-0" / "metrics.csv") as log:
        assert any(row["val/iou"] for row in csv.DictReader(log))


def test_the_same_seed_gives_the_same_weights(tmp_path, quick):
    weights = []
    for number, seed in enumerate((0, 0, 1)):
        quick(tmp_path / str(number), seed=seed)
        weights.append(models.load(tmp_path / str(number) / "iln.safetensors").state_dict())
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    assert not torch.equal(weights[0]["position.weight"], weights[2]["position.weight"])


def test_surfaces_learn_from_any_sensor_by_default(tmp_path, quick, monkeypatch):
    seen = []
    draw = data.ContinuousRays._draw
    monkeypatch.setattr(data.ContinuousRays, "_draw", lambda self, n: seen.append(draw(self, n)) or seen[-1])
    quick(tmp_path, "iln-surfaces", tokens=8, steps=6)
    assert len({batch.sensor for batch in seen}) > 2
    with safe_open(tmp_path / "iln-surfaces.safetensors", "pt") as file:
        assert json.loads(file.metadata()["sensors"]) == ["any"]
    assert isinstance(models.load(tmp_path / "iln-surfaces.safetensors"), models.Surfaces)


def test_the_sensors_of_a_training_can_be_chosen(tmp_path, quick):
    quick(tmp_path, "iln-surfaces", tokens=8, sensors=[preset("os1-32")])
    with safe_open(tmp_path / "iln-surfaces.safetensors", "pt") as file:
        assert json.loads(file.metadata()["sensors"]) == ["os1-32"]


def test_a_variant_of_a_model_learns_by_its_own_loss_and_is_written_as_that_model(tmp_path, quick):
    losses = []

    class Variant(models.ILN):
        def loss(self, *batch, **options):
            losses.append(super().loss(*batch, **options))
            return losses[-1]

    quick(tmp_path, "iln", make=Variant, steps=3)
    assert len(losses) == 3
    with safe_open(tmp_path / "iln.safetensors", "pt") as file:
        assert json.loads(file.metadata()["variant"]) == "Variant"
    assert type(models.load(tmp_path / "iln.safetensors")) is models.ILN


def test_the_number_of_validations_can_be_chosen(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(train, "VALIDATE_EVERY", (1, 2000))
    for validations in (1, 3):
        quick(tmp_path / str(validations), steps=6, validations=validations)
        [log] = (tmp_path / str(validations)).glob("*/from-step-0/metrics.csv")
        with open(log) as rows:
            assert sum(bool(row["val/iou"]) for row in csv.DictReader(rows)) == validations


def test_the_rate_of_surfaces_is_at_most_that_of_the_preset(tmp_path, quick, monkeypatch):
    for rate in (1e-4, 1e-3):
        monkeypatch.setitem(train.PRESETS, "tiny", dataclasses.replace(train.PRESETS["tiny"], rate=rate))
        rates = []
        monkeypatch.setattr(train, "_run", lambda plan, training, *_, to=rates: to.append(training.rate) or {})
        quick(tmp_path, "iln-surfaces", tokens=8)
        quick(tmp_path)
        assert rates == [min(rate, train.RATES["iln-surfaces"]), rate]


def test_a_training_on_any_sensor_goes_on_exactly(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(train, "CHECKPOINT_EVERY", 2)
    options = {"name": "iln-surfaces", "tokens": 8, "steps": 4}
    whole = quick(tmp_path / "whole", **options)
    draw = data.ContinuousRays._draw

    def killed(self, number):
        if number == 3:
            raise RuntimeError("cut")
        return draw(self, number)

    monkeypatch.setattr(data.ContinuousRays, "_draw", killed)
    with pytest.raises(RuntimeError, match="cut"):
        quick(tmp_path / "cut", **options)
    monkeypatch.setattr(data.ContinuousRays, "_draw", draw)
    assert quick(tmp_path / "cut", **options) == whole


def test_a_worker_makes_the_batches_where_cores_are_to_spare(tmp_path, quick, monkeypatch):
    asked = []
    numbers = data.batches._numbers
    monkeypatch.setattr(data.batches, "_numbers", lambda start: asked.append(get_worker_info()) or numbers(start))
    alone = quick(tmp_path / "alone")
    assert asked == [None]
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    assert quick(tmp_path / "beside") == alone
    assert asked == [None]  # asked elsewhere


def test_an_interrupted_run_goes_on_to_the_same_weights(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(train, "CHECKPOINT_EVERY", 2)
    quick(tmp_path / "whole", steps=6)
    with monkeypatch.context() as cut:
        original = train.Training.training_step

        def step_or_die(self, batch, index):
            if self.global_step == 5:
                raise SystemError("power cut")
            return original(self, batch, index)

        cut.setattr(train.Training, "training_step", step_or_die)
        with pytest.raises(SystemError):
            quick(tmp_path / "cut", steps=6)
    assert (tmp_path / "cut" / "iln" / "last.ckpt").exists()
    with pytest.raises(ValueError, match=r"is an interrupted run of .*'steps': 6"):
        quick(tmp_path / "cut", steps=8)
    quick(tmp_path / "cut", steps=6)
    whole, cut = (models.load(tmp_path / run / "iln.safetensors").state_dict() for run in ("whole", "cut"))
    assert all(torch.equal(whole[key], cut[key]) for key in whole)
    # Both starts left their figures, and a finished run leaves no checkpoint to stumble over.
    assert {p.name for p in (tmp_path / "cut" / "iln").iterdir()} == {"from-step-0", "from-step-4"}


def test_a_run_cut_in_a_validation_makes_up_for_it(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(train, "CHECKPOINT_EVERY", 10)
    monkeypatch.setattr(train, "VALIDATE_EVERY", (2, 2))
    quick(tmp_path / "whole", steps=6)
    with monkeypatch.context() as cut:
        original = train.Training.validation_step

        def validate_or_die(self, place, index):
            if self.global_step == 4:
                raise SystemError("power cut")
            return original(self, place, index)

        cut.setattr(train.Training, "validation_step", validate_or_die)
        with pytest.raises(SystemError):
            quick(tmp_path / "cut", steps=6)
    kept = torch.load(tmp_path / "cut" / "iln" / "last.ckpt", weights_only=True)
    [best] = [state["best_model_score"] for key, state in kept["callbacks"].items() if "ModelCheckpoint" in key]
    quick(tmp_path / "cut", steps=6)

    def validated(run):
        found = []
        for log in sorted((tmp_path / run / "iln").glob("from-step-*/metrics.csv")):
            with open(log, newline="") as file:
                found += [(row["step"], row["val/iou"]) for row in csv.DictReader(file) if row["val/iou"]]
        return found

    assert [step for step, _ in validated("whole")] == ["1", "3", "5"]
    assert validated("cut") == validated("whole")
    assert best == pytest.approx(float(validated("cut")[0][1]))  # the run that went on knew how good the best was
    whole, cut = (models.load(tmp_path / run / "iln.safetensors").state_dict() for run in ("whole", "cut"))
    assert all(torch.equal(whole[key], cut[key]) for key in whole)


def test_the_figures_are_those_of_the_final_weights(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(train, "VALIDATE_EVERY", (3, 3))
    figures = quick(tmp_path, steps=5)
    model = models.load(tmp_path / "iln.safetensors")
    [[scan, truth]] = places.held_out_scans(train.places.town(), 1, [PAPER_INPUT, train.VALIDATION])
    mae = metrics.compare(model.ranges(scan, truth.sensor), truth)["mae"]
    assert mae == pytest.approx(figures["val/mae"], rel=0.05)  # float32 here, bfloat16 there


def test_training_lowers_the_loss(quiet_place):
    torch.manual_seed(0)
    model = models.create("iln", features=16, blocks=1, heads=4, dropout=0.0)
    batch = next(iter(data.ContinuousRays([quiet_place([[3, 0, 0]])], PAPER_INPUT, 4, 64, 256, seed=0)))
    training = train.Training(model, [], 1e-3)
    training.log = lambda *args, **kwargs: None
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    losses = []
    for _ in range(30):
        optimizer.zero_grad()
        loss = training.training_step(batch, 0)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_the_loss_is_in_units_of_the_normalised_range(yard):
    model = models.create("iln", features=16, blocks=1, heads=4).eval()
    training = train.Training(model, [], 1e-3)
    training.log = lambda *args, **kwargs: None
    image, truth = torch.full((1, 4, 8), 20.0), torch.full((1, 5), 70.0)
    batch = data.Batch(image, torch.rand(1, 5, 2) * 3, truth, False, PAPER_INPUT.resize(4, 8))
    assert training.training_step(batch, 0).item() == pytest.approx(50 * 2 / 100)


def test_unknown_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match="preset_name is 'huge'; it should be one of paper, laptop, small, tiny"):
        train.train("iln", "huge", tmp_path)
    with pytest.raises(ValueError, match="name is 'bilinear'; it should be one of liif, "):
        train.train("bilinear", "tiny", tmp_path)


def test_the_head_of_a_network_with_a_prior_gets_a_gradient(yard):
    """Zero scores at the start must not be a dead end."""
    model = models.create("iln", prior="perspective", features=16, blocks=1, heads=4)
    here = pose((0.0, 0.0, 1.8))
    image = simulate.scan(yard, preset("paper-16x1024"), here).filled().unsqueeze(0)
    queries = torch.rand(1, 500, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([15.0, 1024.0])
    model(image, queries).sum().backward()
    assert model.head[1].weight.grad.abs().max() > 0


def train_in_yard(out, processes, *arguments):
    out.mkdir()
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1", "CUDA_VISIBLE_DEVICES": ""}
    launcher = ["-m", "torch.distributed.run", f"--nproc-per-node={processes}", "--master-port=0", "--standalone"]
    script = Path(__file__).with_name("train_in_yard.py")
    command = [sys.executable, *(launcher if processes > 1 else []), str(script), str(out), *arguments]
    # A process that waits in vain for another would do so for half an hour.
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]


def test_two_processes_share_a_batch_and_agree_with_one(tmp_path):
    """The same gradients in both, those of one process, and the same figures over all held-out scans."""
    for name, processes in (("one", 1), ("two", 2)):
        train_in_yard(tmp_path / name, processes)
    alone = torch.load(tmp_path / "one" / "rank-alone.pt")
    for rank in (0, 1):
        shared = torch.load(tmp_path / "two" / f"rank-{rank}.pt")
        assert len(shared["gradients"]) == len(alone["gradients"]) == 2
        for ours, expected in zip(shared["gradients"], alone["gradients"], strict=True):
            for name, gradient in expected.items():
                torch.testing.assert_close(
                    ours[name], gradient, rtol=1e-3, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}"
                )
        assert shared["figures"] == pytest.approx(alone["figures"], abs=2e-4)
    assert alone["gradients"][0]["model.head.1.weight"].abs().max() > 0


def test_a_loss_that_is_not_finite_stops_and_keeps_the_batch(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(data.ContinuousRays, "_draw", spoilt(data.ContinuousRays._draw, 2))
    with pytest.raises(ValueError, match=r"the loss of step 2 is nan.*step-2.pt .*weights of step 0"):
        quick(tmp_path)
    kept = torch.load(tmp_path / "iln" / "step-2.pt")
    assert kept["batch"]["ranges"].isnan().any()
    assert Sensor(**kept["batch"]["sensor"]).shape == tuple(kept["batch"]["image"].shape[1:])
    first = models.create("iln", blocks=1, features=16, heads=4)
    assert kept["model"].keys() == first.state_dict().keys()
    assert all(weight.isfinite().all() for weight in kept["model"].values())


@pytest.mark.parametrize("checkpoint_every", [2, 100])
def test_no_checkpoint_holds_weights_after_a_loss_that_is_not_finite(tmp_path, quick, monkeypatch, checkpoint_every):
    """Whether it is time for a checkpoint or for a validation."""
    monkeypatch.setattr(train, "CHECKPOINT_EVERY", checkpoint_every)
    monkeypatch.setattr(train, "VALIDATE_EVERY", (3, 3))
    monkeypatch.setattr(data.ContinuousRays, "_draw", spoilt(data.ContinuousRays._draw, 4))
    with pytest.raises(ValueError, match=r"the loss of step 4 is nan.*weights of step [34]"):
        quick(tmp_path, steps=9)
    kept = torch.load(tmp_path / "iln" / "last.ckpt", weights_only=True)
    assert kept["global_step"] in (3, 4)
    assert all(weight.isfinite().all() for weight in kept["state_dict"].values())


def test_a_loss_is_read_every_few_steps_only(tmp_path, quick, monkeypatch):
    read = []
    original = train._Watch._read
    monkeypatch.setattr(
        train._Watch, "_read", lambda watch, *of: read.append(len(watch.unread)) or original(watch, *of)
    )
    quick(tmp_path, steps=23)
    assert [count for count in read if count] == [10, 10, 3]


def test_all_processes_stop_when_the_loss_of_one_is_not_finite(tmp_path):
    train_in_yard(tmp_path / "two", 2, "1")
    said = [(tmp_path / "two" / f"rank-{rank}.txt").read_text() for rank in (0, 1)]
    assert said[0] == "the loss of step 1 is not finite in another process"
    assert said[1].startswith("the loss of step 1 is nan; it should be finite: ")
    [kept] = (tmp_path / "two" / "iln").glob("step-*.pt")
    assert kept.name == "step-1-process-1.pt"
    assert torch.load(kept)["batch"]["ranges"].isnan().all()


def test_each_process_has_a_gpu_of_its_own(monkeypatch):
    chosen = []
    monkeypatch.setattr(train.simulate, "best_device", lambda: torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    assert train._device() == torch.device("cuda", 0)
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert train._device() == torch.device("cuda", 1)
    assert chosen == [0, 1]
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(ValueError, match="LOCAL_RANK is 2; it should be below 2: start one process for each GPU"):
        train._device()


def spoilt(draw, bad):
    def drawn(self, number):
        batch = draw(self, number)
        return batch._replace(ranges=batch.ranges * torch.nan) if number == bad else batch

    return drawn


def test_stored_images_are_learned_from(tmp_path, quick, monkeypatch):
    sensors = [preset("paper-16x1024"), preset("paper-128x2048")]
    sizes = {"16x1024": sensors[0], "128x2048": sensors[1]}
    archive = data.Archive.create(tmp_path / "data", 2, sizes, {"towns": ["nowhere"]})
    flat = {size: np.full((2, *sensor.shape), 5000, np.uint16) for size, sensor in sizes.items()}
    archive.write(0, flat, np.zeros(2, int), np.zeros(2, int), np.zeros((2, 4, 4)))
    monkeypatch.setitem(train.PRESETS, "tiny", dataclasses.replace(train.PRESETS["tiny"], crops=2, columns=1024))
    figures = quick(tmp_path / "out", archive=tmp_path / "data")
    assert set(figures) == {f"val/{name}" for name in metrics.FIGURES}
    with pytest.raises(ValueError, match=r"archive is None; .*16x1024 and 128x2048, .* iln with preset paper learns"):
        train.train("iln", "paper", tmp_path)
    with pytest.raises(ValueError, match=r"archive is None; .*16x1024 and 64x1024, .* lidar-sr with preset tiny"):
        train.train("lidar-sr", "tiny", tmp_path, target=(64, 1024))
    with pytest.raises(ValueError, match=r"target is 70x1024; for lidar-sr it should be a multiple of 16x1024"):
        train.train("lidar-sr", "tiny", tmp_path, archive=tmp_path / "data", target=(70, 1024))
    with pytest.raises(ValueError, match="sensors is given; it should be None with an archive"):
        quick(tmp_path / "out2", archive=tmp_path / "data", sensors=[PAPER_INPUT])
    with pytest.raises(FileNotFoundError, match="no such folder"):
        quick(tmp_path / "out2", archive=tmp_path / "nothing")


def test_lidar_sr_learns_the_one_size_that_it_predicts(tmp_path, quick, yard):
    sensors = {size: preset(f"paper-{size}") for size in ("16x1024", "64x1024")}
    archive = data.Archive.create(tmp_path / "data", 2, sensors, {"towns": ["nowhere"]})
    flat = {size: np.full((2, *sensor.shape), 5000, np.uint16) for size, sensor in sensors.items()}
    archive.write(0, flat, np.zeros(2, int), np.zeros(2, int), np.zeros((2, 4, 4)))
    figures = train.train("lidar-sr", "tiny", tmp_path, steps=1, archive=tmp_path / "data", target=(64, 1024))
    assert set(figures) == {f"val/{name}" for name in metrics.FIGURES}
    model = models.load(tmp_path / "lidar-sr.safetensors")
    assert (model.rows, model.columns) == (4, 1)
    scan = simulate.scan(yard, sensors["16x1024"], pose((0.0, 0.0, 1.8)))
    assert model.upsample(scan, sensors["64x1024"]).sensor.shape == (64, 1024)


@pytest.mark.parametrize(("name", "halved"), [("iln", [2]), ("lidar-sr", [])])
def test_as_the_authors_train(tmp_path, quick, monkeypatch, name, halved):
    """The rate is halved after epochs, but that of LiDAR-SR never; images are whole, in their own order of columns."""
    sensors = {size: preset(f"paper-{size}") for size in ("16x1024", "64x1024")}
    archive = data.Archive.create(tmp_path / "data", 2, sensors, {"towns": ["nowhere"]})
    images = {size: np.full((2, *sensor.shape), 5000, np.uint16) for size, sensor in sensors.items()}
    images["16x1024"][..., 0] = 1500
    archive.write(0, images, np.zeros(2, int), np.zeros(2, int), np.zeros((2, 4, 4)))
    size = dataclasses.replace(train.PRESETS["tiny"], steps=0, epochs=4, halve_after=(2,), columns=1024)
    monkeypatch.setitem(train.PRESETS, "tiny", size)
    monkeypatch.setattr(train, "_run", lambda plan, training, batches, *rest: (plan, training, batches))
    plan, training, batches = train.train(name, "tiny", tmp_path, archive=tmp_path / "data", target=(64, 1024))
    assert training.halve_after == halved
    assert plan.steps == 4
    image = next(iter(batches)).image
    assert image.shape == (2, 16, 1024)
    assert len(image[..., 0].unique()) == 1
    assert image[..., 0].max() < image[..., 1:].min()
