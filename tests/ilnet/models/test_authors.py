"""Checkpoints of the paper's authors, against their networks rebuilt in plain PyTorch on their own parameters."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from ilnet import models
from ilnet.data.rimg import RangeImageTree
from ilnet.models import authors
from ilnet.scan import Scan

# float32 ranges below 100 m through dozens of layers.
METRES = 1e-3
LIDAR = {"min_r": 2.0, "max_r": 80.0, "norm_r": 100.0, "channels": 16, "points_per_ring": 1024}


def draw(shapes):
    """Random parameters that neither blow up nor fade over many layers."""
    generator = torch.Generator().manual_seed(0)
    state = {}
    for key, shape in shapes.items():
        size = math.prod(shape[1:]) ** -0.5 if len(shape) > 1 else 0.1
        state[key] = torch.randn(shape, generator=generator) * size
        if key.endswith("running_var"):
            state[key] = torch.rand(shape, generator=generator) + 0.5
        elif key.endswith("num_batches_tracked"):
            state[key] = torch.tensor(7)
        elif len(shape) == 1 and key.endswith("weight"):  # of norms
            state[key] = 1 + state[key]
    return state


def with_biases(weights):
    return {
        f"{key}.{kind}": shape if kind == "weight" else shape[:1]
        for key, shape in weights
        for kind in ("weight", "bias")
    }


def encoder_shapes():
    convolutions = [("encoder.head.0.conv", (64, 1, 3, 3))]
    convolutions += [(f"encoder.body.{i}.body.{j}.conv", (64, 64, 3, 3)) for i in range(16) for j in (0, 2)]
    return with_biases([*convolutions, ("encoder.body.16.conv", (64, 64, 3, 3))])


def iln_shapes(depth):
    shapes = encoder_shapes() | with_biases([("attention.pos_embedding", (64, 2))])
    for i in range(depth):
        layer = f"attention.transformer.layers.{i}"
        shapes[f"{layer}.0.fn.to_qkv.weight"] = (192, 64)
        shapes |= with_biases([(f"{layer}.{j}.norm", (64,)) for j in (0, 1)])
        shapes |= with_biases([(f"{layer}.{part}", (64, 64)) for part in ("0.fn.to_out.0", "1.fn.net.0", "1.fn.net.3")])
    return shapes | with_biases([("attention.mlp_head.0", (64,)), ("attention.mlp_head.1", (1, 64))])


def liif_shapes():
    widths = [66, 256, 256, 256, 256, 1]
    return encoder_shapes() | with_biases([(f"imnet.layers.{2 * i}", (widths[i + 1], widths[i])) for i in range(5)])


def norm_shapes(key, channels):
    return with_biases([(key, (channels,))]) | {
        **{f"{key}.running_{what}": (channels,) for what in ("mean", "var")},
        f"{key}.num_batches_tracked": (),
    }


def lidar_sr_shapes(doublings):
    def up(key, given, made):
        return {f"{key}.0.weight": (given, made, 3, 3), f"{key}.0.bias": (made,)} | norm_shapes(f"{key}.1", made)

    def block(key, given, made):
        shapes = {}
        for i, channels in ((0, given), (3, made)):
            shapes |= with_biases([(f"{key}.{i}", (made, channels, 3, 3))]) | norm_shapes(f"{key}.{i + 1}", made)
        return shapes

    shapes = {}
    for i in range(doublings):
        shapes |= up(f"up_scale.conv.{i}.up_block", 64 if i else 1, 64)
    shapes |= block(f"up_scale.conv.{doublings}.conv_block", 64, 64)
    for i, channels in ((1, 64), (2, 128), (3, 256)):
        shapes |= block(f"down{i}.down.2.conv_block", channels, 2 * channels)
    shapes |= block("downup.0.down.2.conv_block", 512, 1024) | up("downup.2.up_block", 1024, 512)
    for i, channels in ((1, 512), (2, 256), (3, 128)):
        shapes |= block(f"up{i}.up.0.conv_block", 2 * channels, channels)
        shapes |= up(f"up{i}.up.2.up_block", channels, channels // 2)
    return shapes | block("outc.conv.0.conv_block", 128, 64) | with_biases([("outc.conv.1", (1, 64, 1, 1))])


def linear(state, key, x):
    return F.linear(x, state[f"{key}.weight"], state.get(f"{key}.bias"))


def layer_norm(state, key, x):
    return F.layer_norm(x, x.shape[-1:], state[f"{key}.weight"], state[f"{key}.bias"])


def encoded(state, image):
    """EDSR: columns go round, rows repeat."""

    def convolve(key, x):
        x = F.pad(F.pad(x, (1, 1, 0, 0), "circular"), (0, 0, 1, 1), "replicate")
        return F.conv2d(x, state[f"{key}.weight"], state[f"{key}.bias"])

    head = convolve("encoder.head.0.conv", (image / 50 - 1)[:, None])
    x = head
    for i in range(16):
        block = f"encoder.body.{i}.body"
        x = x + convolve(f"{block}.2.conv", convolve(f"{block}.0.conv", x).relu())
    return head + convolve("encoder.body.16.conv", x)


def neighbours(image, queries):
    """Values (Q, 4, C) of an image (C, H, W) around queries (Q, 2), offsets (Q, 4, 2) and areas (Q, 4)."""
    corner = queries.floor()
    moves = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    pixels = corner[:, None] + moves
    offsets = queries[:, None] - pixels
    rows, columns = pixels.long().unbind(-1)
    values = image[:, rows.clamp(0, image.shape[1] - 1), columns % image.shape[2]]
    # The area of each belongs to the neighbour diagonally opposite.
    return values.movedim(0, -1), offsets, offsets.abs().prod(-1).flip(-1)


def plain_iln(state, depth, image, queries):
    z, offsets, _ = neighbours(encoded(state, image)[0], queries)
    z = z + linear(state, "attention.pos_embedding", 2 * offsets)
    for i in range(depth):
        layer = f"attention.transformer.layers.{i}"
        qkv = linear(state, f"{layer}.0.fn.to_qkv", layer_norm(state, f"{layer}.0.norm", z))
        q, k, v = (part.unflatten(-1, (8, 8)).transpose(1, 2) for part in qkv.chunk(3, -1))
        attended = ((q @ k.mT) / 8**0.5).softmax(-1) @ v
        z = z + linear(state, f"{layer}.0.fn.to_out.0", attended.transpose(1, 2).flatten(-2))
        hidden = F.gelu(linear(state, f"{layer}.1.fn.net.0", layer_norm(state, f"{layer}.1.norm", z)))
        z = z + linear(state, f"{layer}.1.fn.net.3", hidden)
    scores = linear(state, "attention.mlp_head.1", layer_norm(state, "attention.mlp_head.0", z))
    ranges, _, _ = neighbours(image, queries)
    return (scores.softmax(1) * ranges).sum((1, 2))


def plain_liif(state, image, queries):
    z, offsets, areas = neighbours(encoded(state, image)[0], queries)
    x = torch.cat((z, 2 * offsets), -1)
    for i in range(0, 8, 2):
        x = linear(state, f"imnet.layers.{i}", x).relu()
    values = linear(state, "imnet.layers.8", x).squeeze(-1)
    return ((values * areas).sum(1) / areas.sum(1) + 1) * 50


def plain_lidar_sr(state, strides, image):
    def norm(key, x):
        numbers = (state[f"{key}.{name}"] for name in ("running_mean", "running_var", "weight", "bias"))
        return F.batch_norm(x, *numbers).relu()

    def up(key, x, stride=(2, 2)):
        weight, bias = state[f"{key}.0.weight"], state[f"{key}.0.bias"]
        more = [s - 1 for s in stride]
        return norm(f"{key}.1", F.conv_transpose2d(x, weight, bias, stride, padding=1, output_padding=more))

    def block(key, x):
        for i in (0, 3):
            x = norm(f"{key}.{i + 1}", F.conv2d(x, state[f"{key}.{i}.weight"], state[f"{key}.{i}.bias"], padding=1))
        return x

    x = image[:, None] / 100
    for i, stride in enumerate(strides):
        x = up(f"up_scale.conv.{i}.up_block", x, stride)
    skips = [block(f"up_scale.conv.{len(strides)}.conv_block", x)]
    for key in ("down1.down", "down2.down", "down3.down", "downup.0.down"):
        skips.append(block(f"{key}.2.conv_block", F.avg_pool2d(skips[-1], 2)))
    x = up("downup.2.up_block", skips.pop())
    for i in (1, 2, 3):
        x = up(f"up{i}.up.2.up_block", block(f"up{i}.up.0.conv_block", torch.cat((skips.pop(), x), 1)))
    x = block("outc.conv.0.conv_block", torch.cat((skips.pop(), x), 1))
    return F.conv2d(x, state["outc.conv.1.weight"], state["outc.conv.1.bias"]).relu()[:, 0] * 100


def save(path, name, arguments, state, **more):
    model = {"name": name, "args": arguments, "state_dict": state}
    torch.save({"epoch": 400, "model": model, "optimizer": {}, "lr_scheduler": {}, "lidar_in": LIDAR, **more}, path)
    return path


def pose_queries():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 6, 16, generator=generator) * 78 + 2
    return image, torch.rand(200, 2, generator=generator) * torch.tensor([5.0, 16.0])


@pytest.mark.parametrize("depth", [0, 1, 2])
def test_iln(tmp_path, depth):
    state, (image, queries) = draw(iln_shapes(depth)), pose_queries()
    model = models.load(save(tmp_path / "a.pth", "iln", {"d": depth, "h": 8}, state))
    expected = plain_iln(state, depth, image, queries)
    with torch.no_grad():
        torch.testing.assert_close(model(image, queries[None])[0], expected, rtol=0, atol=METRES)
    assert expected.std() > 5


def test_liif(tmp_path):
    state, (image, queries) = draw(liif_shapes()), pose_queries()
    arguments = {"local_ensemble": True, "feat_unfold": False, "cell_decode": False}
    model = models.load(save(tmp_path / "a.pth", "liif_lidar", arguments, state))
    expected = plain_liif(state, image, queries)
    with torch.no_grad():
        torch.testing.assert_close(model(image, queries[None])[0], expected, rtol=0, atol=METRES)
    assert expected.std() > 1


@pytest.mark.parametrize(
    ("rows", "columns", "strides"),
    [(8, 2, [(2, 2), (2, 1), (2, 1)]), (2, 4, [(2, 2), (1, 2)])],
)
def test_lidar_sr(tmp_path, rows, columns, strides):
    state = draw(lidar_sr_shapes(len(strides)))
    state["outc.conv.1.bias"] += 0.5
    arguments = {"scale_h": rows, "scale_w": columns, "dropout_rate": 0.25}
    model = models.load(save(tmp_path / "a.pth", "lsr", arguments, state))
    image, _ = pose_queries()
    image = image[:, :4].repeat(1, 2, 2)
    with torch.no_grad():
        expected = plain_lidar_sr(state, strides, image)
        torch.testing.assert_close(model.encode(image, True), expected, rtol=0, atol=METRES)
    assert expected.shape == (1, 8 * rows, 32 * columns)
    assert expected.std() > 0.1


@pytest.mark.parametrize(
    ("files", "name", "arguments"),
    [
        ("iln_1d", "iln", {"depth": 1}),
        ("iln_2d", "iln", {"depth": 2}),
        ("liif", "liif", {}),
        ("lsr_4h_1w", "lidar-sr", {"rows": 4, "columns": 1}),
        ("lsr_8h_2w", "lidar-sr", {"rows": 8, "columns": 2}),
        ("lsr_16h_4w", "lidar-sr", {"rows": 16, "columns": 4}),
    ],
)
def test_every_parameter_of_theirs_is_one_of_ours(shared, files, name, arguments):
    theirs = json.loads((shared / "data/authors/state_dict_keys.json").read_text())[files]
    with torch.device("meta"):
        ours = models.create(name, **arguments).state_dict()
    assert {authors._rename(key): shape for key, shape in theirs.items()} == {k: list(v.shape) for k, v in ours.items()}


def test_norm_range_is_that_of_their_sensor(tmp_path):
    path = save(tmp_path / "a.pth", "iln", {"d": 1, "h": 8}, draw(iln_shapes(1)), lidar_in={**LIDAR, "norm_r": 60})
    assert models.load(path).norm_range == 60


class Trap:
    """What a checkpoint with a program in it is made of."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_a_checkpoint_that_holds_a_program_is_refused_and_not_run(tmp_path):
    trap = tmp_path / "ran"
    path = save(tmp_path / "a.pth", "iln", {"d": 1, "h": 8}, draw(iln_shapes(1)), optimizer=Trap(trap))
    with pytest.raises(ValueError, match=r"a.pth: holds more than tensors and plain values"):
        models.load(path)
    assert not trap.exists()


ARGUMENTS = {"d": 1, "h": 8}
BAD = {
    "another model": (("tulip", ARGUMENTS), "its model is 'tulip'; it should be one of iln, liif_lidar, lsr"),
    "another argument": (("iln", {**ARGUMENTS, "windows": 3}), "unknown here: windows"),
    "another variant": (("liif_lidar", {"feat_unfold": True}), "feat_unfold = True; only False"),
    "another depth": (
        ("iln", {"d": 2, "h": 8}),
        "parameters are missing, unknown or of another shape, such as blocks.1",
    ),
    "another number of heads": (("iln", {"d": 1, "h": 7}), "heads is 7"),
    "arguments that are none": (("iln", {"d": "one", "h": 8}), "not weights of iln"),
}


@pytest.mark.parametrize("case", BAD)
def test_unknown_variants_are_refused(tmp_path, case):
    (name, arguments), message = BAD[case]
    path = save(tmp_path / "a.pth", name, arguments, draw(iln_shapes(1)))
    with pytest.raises(ValueError, match=r"a\.pth: ") as error:
        models.load(path)
    assert message in str(error.value)
    assert len(str(error.value)) < 300


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "a.pth"
    path.write_text("hello")
    with pytest.raises(ValueError, match=r"a\.pth: "):
        models.load(path)
    whole = save(tmp_path / "whole.pth", "iln", ARGUMENTS, draw(iln_shapes(1))).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"a\.pth: "):
        models.load(path)
    for content in ({"state_dict": {}}, [1, 2], {"model": 3, "lidar_in": LIDAR}, torch.zeros(3)):
        torch.save(content, path)
        with pytest.raises(ValueError, match=r"a\.pth: not a checkpoint of the authors' code"):
            models.load(path)
    with pytest.raises(FileNotFoundError, match="no such file of weights"):
        models.load(tmp_path / "none.pth")


@pytest.mark.parametrize("name", ["iln_1d_random", "liif_random"])
def test_their_checkpoints_answer_their_scans_as_their_code_does(shared, tmp_path, name):
    """Through `ranges`, for scans whose azimuths fall as in their files, and for the same scans in our order."""
    folder = shared / "data/authors"
    expected = np.load(folder / f"{name.removesuffix('_random')}_expected.npz")
    sensors = RangeImageTree(folder).sensors
    # Their image has ranges nearer than the sensor's minimum.
    source, target = (dataclasses.replace(sensors[size], min_range=0.0) for size in ("16x1024", "64x1024"))
    image = torch.from_numpy(expected["range_image_m"]).float()
    image = image.where(image <= source.max_range, 0.0)
    row, column = torch.from_numpy(expected["pixel"]).long().unbind(-1)
    away = (column > 40) & (column < 1024 - 40)  # their neighbours clamp at the seam, and convolutions see across it
    metres = (torch.from_numpy(expected["output_normalised"]).float().flatten() + 1) * 50
    model = models.load(folder / f"{name}.pth")
    models.save(model, tmp_path / "ours.safetensors", name.partition("_")[0], {})
    for loaded in (model, models.load(tmp_path / "ours.safetensors")):
        theirs = loaded.ranges(Scan(image, source), target)[row, column]
        torch.testing.assert_close(theirs[away], metres[away], rtol=0, atol=0.01)
        ours = loaded.ranges(Scan(image.flip(-1), source.upright()), target.upright()).flip(-1)[row, column]
        torch.testing.assert_close(ours, theirs, rtol=0, atol=METRES)
