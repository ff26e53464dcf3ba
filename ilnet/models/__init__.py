"""The models by name: made untrained, or loaded from a file of weights."""

import json
import math
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from ilnet import memory
from ilnet.models import authors
from ilnet.models.base import PRECISIONS, Answer, Model, Upsampler, returns
from ilnet.models.bilinear import Bilinear, Nearest, Planes
from ilnet.models.iln import ILN
from ilnet.models.lidar_sr import LiDARSR
from ilnet.models.liif import LIIF
from ilnet.models.surfaces import Surfaces

__all__ = [
    "ILN",
    "LIIF",
    "NAMES",
    "PRECISIONS",
    "TRAINABLE",
    "Answer",
    "Bilinear",
    "LiDARSR",
    "Model",
    "Nearest",
    "Planes",
    "Surfaces",
    "Upsampler",
    "card",
    "create",
    "load",
    "returns",
    "save",
]

_MODELS: dict[str, tuple[type[Model], dict[str, Any]]] = {
    "nearest": (Nearest, {}),
    "bilinear": (Bilinear, {}),
    "bilinear-inverse": (Bilinear, {"inverse": True}),
    "planes": (Planes, {}),
    "liif": (LIIF, {}),
    "lidar-sr": (LiDARSR, {}),
    "iln": (ILN, {}),
    "iln-surfaces": (Surfaces, {}),
}
NAMES = tuple(_MODELS)
TRAINABLE = tuple(name for name, (kind, _) in _MODELS.items() if kind not in (Nearest, Bilinear, Planes))

_SHIPPED = Path(__file__).parents[1] / "weights"


def create(name: str, **arguments: Any) -> Model:
    """Returns an untrained model.

    Args:
        name: One of `NAMES`.
        **arguments: Arguments of the constructor; they override those that the name stands for.

    Raises:
        ValueError: If there is no such model.
    """
    if name not in _MODELS:
        raise ValueError(f"name is {name!r}; it should be one of {', '.join(NAMES)}")
    kind, defaults = _MODELS[name]
    return kind(**{**defaults, **arguments})


def save(model: Model, path: str | Path, name: str, arguments: dict[str, Any], **card: Any) -> None:
    """Writes weights, with all that is needed to make the model again.

    They are stored in half precision, which changes no figure of the project.

    Args:
        model: The model whose weights are written.
        path: A `.safetensors` file; its folder is made if it is missing.
        name: One of `NAMES`.
        arguments: Arguments of the constructor beyond those that the name stands for today. Both are written.
        **card: How the model was trained; JSON values.

    Raises:
        OSError: If the file cannot be written.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    about = {"name": name, "arguments": {**_MODELS[name][1], **arguments}, "falling": model.falling, **card}
    state = {key: value.detach().cpu().contiguous() for key, value in model.state_dict().items()}
    weights = {key: value.half() if value.is_floating_point() else value for key, value in state.items()}
    try:
        save_file(weights, path, {key: json.dumps(value) for key, value in about.items()})
    except SafetensorError as error:
        raise OSError(f"{path}: cannot be written ({error})") from error


def load(name: str | Path) -> Model:
    """Returns a trained model on the CPU, ready to predict; `model.to(device)` moves it to where the scans are.

    Args:
        name: One of `NAMES`, for the weights that ship with the package; or a `.safetensors` file that `save` wrote; or
            a `.pth` checkpoint of the authors' ILN, LIIF or LiDAR-SR. Nothing in a file is ever executed.

    Raises:
        FileNotFoundError: If there is no such file, or no weights ship for that name.
        ValueError: If `name` is neither a name nor a file of weights.
    """
    if name in NAMES and name not in TRAINABLE:
        return create(str(name)).eval()
    path = _SHIPPED / f"{name}.safetensors" if name in NAMES else Path(name)
    if name in NAMES and not path.is_file():
        raise FileNotFoundError(f"no weights ship for {name}; train them: `python -m ilnet train {name}`")
    if path.suffix not in (".safetensors", ".pth"):
        raise ValueError(
            f"name is {str(name)!r}; it should be one of {', '.join(NAMES)}, a .safetensors file, "
            "or a .pth checkpoint of the paper's authors"
        )
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of weights")
    memory.check(str(path), 3 * path.stat().st_size)
    if path.suffix == ".pth":
        kind, arguments, state = authors.read(path)
        falling = True
    else:
        kind, arguments, state, falling = _read(path)
    try:
        _check_arguments(arguments, state)
        with torch.device("meta"):  # takes no memory, whatever the arguments ask for
            _check_shapes(create(kind, **arguments), state)
        model = create(kind, **arguments)
        model.load_state_dict(state)
    except (TypeError, ValueError, RuntimeError, ArithmeticError) as error:
        raise ValueError(f"{path}: not weights of {kind!s:.80} ({_line(error)})") from error
    model.falling = falling
    return model.eval()


def card(name: str | Path) -> dict[str, Any]:
    """Returns how the weights of `load` were trained: their steps, minutes, preset and so on; empty for a rule.

    Args:
        name: One of `NAMES`, or a `.safetensors` file that `save` wrote.
    """
    if name in NAMES and name not in TRAINABLE:
        return {}
    with safe_open(_SHIPPED / f"{name}.safetensors" if name in NAMES else name, "pt") as file:
        return {key: json.loads(value) for key, value in file.metadata().items()}


# The largest range that can stand for no return [m].
_FARTHEST = 1e6


def _check_arguments(arguments: dict[str, Any], state: dict[str, Any]) -> None:
    """Raises a ValueError unless the parameters can be those of a network with these arguments."""
    # Layers and channels are at most as many as there are parameters, or values along an axis of one.
    shapes = [getattr(value, "shape", ()) for value in state.values()]
    most = max(len(state), *(max(shape, default=0) for shape in shapes), 0)
    for name, value in arguments.items():
        number = isinstance(value, int | float)
        if name == "norm_range" and not (number and 0 < value <= _FARTHEST):
            raise ValueError(f"norm_range is {value!s:.80}; it should be a number of metres above 0")
        if not (number or isinstance(value, str)) or (isinstance(value, float) and not math.isfinite(value)):
            raise ValueError(f"{name} is {value!s:.80}; it should be a finite number or a text")
        if isinstance(value, int) and name != "norm_range" and value > most:
            raise ValueError(f"{name} is {value!s:.80}; parameters of these shapes allow {most} at most")


def _check_shapes(model: Model, state: dict[str, Any]) -> None:
    """Raises a ValueError of one line, where torch writes one for each parameter; of NaN and infinite ones too."""
    shapes = [{key: getattr(value, "shape", None) for key, value in s.items()} for s in (model.state_dict(), state)]
    wrong = [key for key in sorted(shapes[0].keys() | shapes[1].keys()) if shapes[0].get(key) != shapes[1].get(key)]
    if wrong:
        raise ValueError(f"{len(wrong)} parameters are missing, unknown or of another shape, such as {wrong[0]}")
    bad = [key for key, value in sorted(state.items()) if value.is_floating_point() and not value.isfinite().all()]
    if bad:
        raise ValueError(f"{len(bad)} parameters hold NaN or infinite values, such as {bad[0]}")


def _line(error: BaseException) -> str:
    """Returns an error as one short line."""
    return f"{' '.join(str(error).split()):.300}"


def _read(path: Path) -> tuple[str, dict[str, Any], dict[str, torch.Tensor], bool]:
    """Returns what `save` wrote: name, arguments, parameters and whether azimuths fall."""
    try:
        with safe_open(path, "pt") as file:
            about = {key: json.loads(value) for key, value in (file.metadata() or {}).items()}
        return about["name"], dict(about["arguments"]), load_file(path), bool(about.get("falling"))
    except (SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not weights that `models.save` wrote ({_line(error)})") from error
