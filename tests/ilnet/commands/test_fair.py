from itertools import product

import pytest
import torch

from ilnet import models
from ilnet.commands import fair, study
from ilnet.commands.fair import CONTROL, DECODERS, KINDS, STARTS, rehearsing, variant
from ilnet.sensor import PAPER_INPUT
from ilnet.world import simulate
from ilnet.world.simulate import pose

SMALL = {name: {"features": 16, "blocks": 1} for name in ("attention", CONTROL)}
SMALL["MLP"] = {"features": 16, "blocks": 1, "hidden": 16}


@pytest.fixture(scope="module")
def asked(yard):
    """An image, queries between its pixels, and the ranges there."""
    sensors = PAPER_INPUT, PAPER_INPUT.resize(31, 256)
    scan, truth = (simulate.scan(yard, sensor, pose((3.0, 0.0, 1.8))) for sensor in sensors)
    queries = scan.sensor.grid_queries(truth.sensor).view(1, -1, 2)
    return scan.filled().unsqueeze(0), queries[:, ::7], truth.filled().view(1, -1)[:, ::7]


def answers(model, asked):
    with torch.no_grad():
        return model.eval()(*asked[:2])


@pytest.mark.parametrize(("kind", "decoder"), [*product(("corrections", "weights"), DECODERS)])
def test_what_starts_from_bilinear_is_bilinear(asked, kind, decoder):
    torch.manual_seed(0)
    bilinear = answers(models.create("bilinear"), asked)
    untrained = answers(variant(kind, decoder, STARTS[1])(**SMALL[decoder]), asked)
    # The least area of a weight is not 0.
    torch.testing.assert_close(untrained, bilinear, rtol=0, atol=0.05)
    other = answers(variant(kind, decoder, STARTS[0])(**SMALL[decoder]), asked)
    assert (other - bilinear).abs().mean() > 0.05


@pytest.mark.parametrize("decoder", DECODERS)
def test_values_and_corrections_differ_by_the_measured_ranges_and_nothing_else(asked, decoder):
    image = asked[0]
    found = {}
    for kind in KINDS:
        torch.manual_seed(0)
        found[kind] = variant(kind, decoder, STARTS[0])(**SMALL[decoder])
    state = found["values"].state_dict()
    for model in found.values():
        assert all(torch.equal(state[key], value) for key, value in model.state_dict().items())
    # With (h + 1) R / 2 against r_t + h R / 2, the answers differ by bilinear interpolation less R / 2.
    difference = answers(found["corrections"], asked) - answers(found["values"], asked)
    torch.testing.assert_close(difference, answers(models.create("bilinear"), asked) - 50, rtol=0, atol=1e-3)
    inside = answers(found["weights"], asked)
    assert image.min() - 1e-3 <= inside.min()
    assert inside.max() <= image.max() + 1e-3


@pytest.mark.parametrize("decoder", DECODERS)
def test_values_learn_bilinear_before_they_start_from_it(asked, decoder, tmp_path):
    torch.manual_seed(0)
    model = rehearsing(decoder)(**SMALL[decoder])
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    bilinear = answers(models.create("bilinear"), asked)
    before = (answers(model, asked) - bilinear).abs().mean()
    nonsense = torch.full_like(asked[2], 1.0)  # no rehearsal looks at the true ranges
    for _ in range(30):
        optimizer.zero_grad()
        model.train().loss(*asked[:2], nonsense, True, PAPER_INPUT).backward()
        optimizer.step()
    after = (answers(model, asked) - bilinear).abs().mean()
    assert after < before / 2
    file = tmp_path / "rehearsed.safetensors"
    models.save(model, file, DECODERS[decoder], SMALL[decoder])
    started = variant("values", decoder, STARTS[1], file)(**SMALL[decoder])
    torch.testing.assert_close(answers(started, asked), answers(model, asked), rtol=0, atol=0.5)  # halves are stored


def test_the_loss_is_that_of_the_answers_and_reaches_all_weights(asked):
    for kind, decoder in product(KINDS, DECODERS):
        model = variant(kind, decoder, STARTS[0])(**SMALL[decoder]).train()
        loss = model.loss(*asked, True, PAPER_INPUT)
        torch.testing.assert_close(loss, (answers(model, asked) - asked[2]).abs().mean() / 50)
        loss.backward()
        # The softmax does not depend on a bias that all four scores share.
        still = [name for name, weight in model.named_parameters() if weight.grad is None or not weight.grad.any()]
        assert all(name.endswith("bias") for name in still), (kind, decoder, still)


def test_the_control_of_attention_has_all_but_attention(asked):
    torch.manual_seed(0)
    control = variant("weights", CONTROL, STARTS[0])(**SMALL[CONTROL])
    torch.manual_seed(0)
    whole = variant("weights", "attention", STARTS[0])(**SMALL["attention"])
    with torch.no_grad():
        whole.blocks[0].attention.out.weight.zero_()
        whole.blocks[0].attention.out.bias.zero_()
    torch.testing.assert_close(answers(control, asked), answers(whole, asked), rtol=0, atol=1e-2)


def test_a_network_is_measured_once(tmp_path, monkeypatch):
    files = [tmp_path / f"{name}.safetensors" for name in ("one", "other")]
    compared = []
    monkeypatch.setattr(
        study.Study, "compare", lambda self, some: compared.append(len(some)) or [{"model": name} for name in some]
    )
    study.Study(None, tmp_path, 1).measured_once({files[0]: "a network"})
    found = study.Study(None, tmp_path, 1).measured_once(dict.fromkeys(files, "a network"))
    assert found == {file: [{"model": str(file)}] for file in files}
    study.Study(None, tmp_path, 2).measured_once({files[0]: "a network"})  # other scans
    assert compared == [1, 1, 1]


def test_spread_has_means_and_spans():
    row = {"kind": "weights", "decoder": "MLP", "start": STARTS[0], "size": "64x1024", "mae": 1.0, "floating": 0.1}
    rows = [row | {"seed": seed, "iou": iou} for seed, iou in enumerate((0.2, 0.3, 0.4))]
    [line] = study.spans(rows, fair.FAIR_KEYS)
    assert line["iou"] == "0.300 (0.200 to 0.400)"
    assert line["mae"] == "1.000 (1.000 to 1.000)"
