"""Checkpoints of the paper's authors: their names for our models and parameters."""

import pickle
import re
import zipfile
from pathlib import Path
from typing import Any

import torch

__all__ = ["read"]

# Patterns of their parameters' names, and ours.
_PARAMETERS = [
    (r"encoder\.head\.0\.conv\.", "encoder.head."),
    (r"encoder\.body\.(\d+)\.body\.0\.conv\.", r"encoder.blocks.\1.first."),
    (r"encoder\.body\.(\d+)\.body\.2\.conv\.", r"encoder.blocks.\1.second."),
    (r"encoder\.body\.\d+\.conv\.", "encoder.tail."),
    (r"attention\.pos_embedding\.", "position."),
    (r"attention\.transformer\.layers\.(\d+)\.0\.norm\.", r"blocks.\1.attention.norm."),
    (r"attention\.transformer\.layers\.(\d+)\.0\.fn\.to_qkv\.", r"blocks.\1.attention.qkv."),
    (r"attention\.transformer\.layers\.(\d+)\.0\.fn\.to_out\.0\.", r"blocks.\1.attention.out."),
    (r"attention\.transformer\.layers\.(\d+)\.1\.norm\.", r"blocks.\1.feed_forward.0."),
    (r"attention\.transformer\.layers\.(\d+)\.1\.fn\.net\.0\.", r"blocks.\1.feed_forward.1."),
    (r"attention\.transformer\.layers\.(\d+)\.1\.fn\.net\.3\.", r"blocks.\1.feed_forward.4."),
    (r"attention\.mlp_head\.", "head."),
    (r"imnet\.layers\.", "value."),
    (r"up_scale\.conv\.(\d+)\.(?:up|conv)_block\.", r"widen.\1."),
    *((rf"down{i + 1}\.down\.2\.conv_block\.", f"down.{i}.") for i in range(3)),
    (r"downup\.0\.down\.2\.conv_block\.", "down.3."),
    (r"downup\.2\.up_block\.", "up.0."),
    (r"up([123])\.up\.2\.up_block\.", r"up.\1."),
    *((rf"up{i + 1}\.up\.0\.conv_block\.", f"merge.{i}.") for i in range(3)),
    (r"outc\.conv\.0\.conv_block\.", "merge.3."),
    (r"outc\.conv\.1\.", "last."),
]
# Their models by name: ours, and for each of their arguments our name and their default. Where our name is None, our
# model does only what the default says.
_MODELS: dict[str, tuple[str, dict[str, tuple[str | None, Any]]]] = {
    "iln": ("iln", {"d": ("depth", 1), "h": ("heads", 8)}),
    "liif_lidar": (
        "liif",
        {"local_ensemble": (None, True), "feat_unfold": (None, False), "cell_decode": (None, False)},
    ),
    "lsr": (
        "lidar-sr",
        {"scale_h": ("rows", 4), "scale_w": ("columns", 1), "dropout_rate": ("dropout", 0.25)},
    ),
}


def read(path: Path) -> tuple[str, dict[str, Any], dict[str, torch.Tensor]]:
    """Reads a checkpoint. Nothing in it is ever executed.

    Args:
        path: A `.pth` file that the authors' code saved.

    Returns:
        Name and arguments for `models.create`, and the parameters of that model.

    Raises:
        ValueError: If the file is not such a checkpoint, holds more than tensors and plain values, or holds a variant
            that our models do not have.
    """
    try:
        checkpoint = torch.load(path, weights_only=True, map_location="cpu")
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"{path}: holds more than tensors and plain values, or is damaged; nothing in it was run"
        ) from error
    except (RuntimeError, EOFError, zipfile.BadZipFile, ValueError, LookupError) as error:
        raise ValueError(f"{path}: it is not a whole checkpoint") from error
    try:
        content = dict(checkpoint)
        model, norm_range = content["model"], float(content["lidar_in"]["norm_r"])
        theirs, given, state = str(model["name"]), dict(model["args"]), dict(model["state_dict"])
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"{path}: not a checkpoint of the authors' code, which holds model and lidar_in") from error
    if theirs not in _MODELS:
        raise ValueError(f"{path}: its model is {theirs!r}; it should be one of {', '.join(_MODELS)}")
    name, known = _MODELS[theirs]
    arguments: dict[str, Any] = {"norm_range": norm_range}
    if unknown := set(given) - set(known):
        raise ValueError(f"{path}: its {theirs} has arguments unknown here: {', '.join(sorted(map(str, unknown)))}")
    for key, (ours, default) in known.items():
        value = given.get(key, default)
        if ours:
            arguments[ours] = value
        elif value != default:
            raise ValueError(f"{path}: its {theirs} has {key} = {value}; only {default} is known here")
    if not all(isinstance(key, str) for key in state):
        raise ValueError(f"{path}: its parameters have names that are no text; it is damaged")
    return name, arguments, {_rename(key): value for key, value in state.items()}


def _rename(key: str) -> str:
    for pattern, ours in _PARAMETERS:
        key, count = re.subn("^" + pattern, ours, key)
        if count:
            break
    return key
