"""The poses in a result's file: JSON of `bound`, `fuse` or `align`, or the lines of `bound --poses`."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import se3
from ..camera import Intrinsics
from ..errors import CameraError, DocumentError, PoseError
from ..files import read_text
from ..se3 import Array
from .documents import ALIGN_SCHEMA, FUSE_SCHEMA, SCHEMA
from .estimates import AXES, Estimate, estimate_of

KNOWN = (SCHEMA, FUSE_SCHEMA, ALIGN_SCHEMA)
"""Schemas of the documents that have poses with covariances."""

_WITHOUT = {
    "validate": "errors of an estimator, not a pose's covariance: give the JSON of the bound",
    "select": "tiles, not a pose's covariance: give the JSON of fuse",
}
_ABSURD = 1e100
"""Squares of such numbers leave float64."""
_ROUNDING = 1e-6
_GIVE = "give what bound, fuse or align wrote with --json"
_CAMERA = f"the camera, {AXES['mitsuba'][1]}"


def load_estimates(path: Path, *, misspecified: bool = False) -> list[Estimate]:
    """The poses of a result, in the camera's or the body's frame.

    Args:
        path: what `--json` wrote.
        misspecified: take the covariance that counts what the map does not explain, not the ideal bound's.

    Raises:
        DocumentError: no such file, damaged, of another version or kind, or without what is asked for.
    """
    text = read_text(path, DocumentError)
    documents = _lines(path, text) if text.startswith('{"index": ') else [_parsed(text, str(path))]
    estimates = []
    for number, document in enumerate(documents):
        where = f"{path}, line {number + 1}" if len(documents) > 1 else str(path)
        _check_kind(document, where)
        try:
            estimates.append(_estimate(document, where, misspecified))
        except (KeyError, TypeError, ValueError, AttributeError, CameraError, PoseError) as error:
            reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
            raise DocumentError(f"{where} is damaged: {reason}; write it again") from error
    if not estimates:
        raise DocumentError(f"{path} holds no whole line, so no pose; run its command again, which resumes")
    return estimates


def _lines(path: Path, text: str) -> list[Any]:
    """Of a run that was interrupted the last line may be cut short, and is none."""
    return [_parsed(line, f"{path}, line {n + 1}") for n, line in enumerate(text.split("\n")[:-1])]


def _parsed(text: str, where: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # the latter of thousands of brackets
        raise DocumentError(f"{where} is no JSON: {error}; {_GIVE}") from None


def _check_kind(document: Any, where: str) -> None:
    schema = document.get("schema") if isinstance(document, Mapping) else None
    if schema in KNOWN:
        return
    if not isinstance(schema, str) or not schema.startswith("mitsuba-crb/"):
        raise DocumentError(f"{where} is no result of mitsuba-crb: {_GIVE}")
    kind = schema.split("/")[1]
    if kind in _WITHOUT:
        raise DocumentError(f"{where} has {_WITHOUT[kind]}")
    known = next((known for known in KNOWN if known.split("/")[1] == kind), None)
    if known is None:
        raise DocumentError(f"{where} is of {kind}, and has no poses with covariances; {_GIVE}")
    raise DocumentError(
        f"{where} is of another version: its schema is {reprlib.repr(schema)}, not {known!r}; write it again "
        f"with this mitsuba-crb {kind}"
    )


def _estimate(document: Mapping[str, Any], where: str, misspecified: bool) -> Estimate:
    kind = document["schema"].split("/")[1]
    if kind == "align" and document["verdict"] != "aligned":
        raise DocumentError(
            f"{where}: the photograph was not aligned ({document['verdict']}), so that nothing is known of "
            "its pose; align it first"
        )
    bound = document["ideal"] if kind == "align" else document
    blind = bound["unobserved"]
    found = estimate_of(
        name=_name(document, kind),
        pose=se3.as_pose(document["pose"]),
        frame=_one_of(bound["frame"], ("camera", "world")),
        covariance=_numbers(bound["covariance"], (6, 6)) if blind else _symmetric(bound["covariance"]),
        information=_symmetric(bound["information"]),
        unseen=_orthonormal([each["direction"] for each in blind]),
        words=[f"{each['description']} ({each['verdict']})" for each in blind],
        length_scale=_positive(bound["length_scale"]),
        body=f"the body {document['body']!r}, its own axes" if kind == "fuse" else _CAMERA,
        camera=_camera(document),
        of_camera=kind != "fuse",
    )
    return _misspecified(document, found, where) if misspecified else found


def _misspecified(document: Mapping[str, Any], ideal: Estimate, where: str) -> Estimate:
    own = document.get("misspecified")
    if own is None:
        raise DocumentError(
            f"{where} has no misspecified covariance (bound --photographs finds it); leave out --misspecified"
        )
    if ideal.words:
        raise DocumentError(
            f"{where}: {ideal.words[0]}, of which the misspecified covariance says nothing; leave out "
            "--misspecified"
        )
    covariance = _symmetric(own["covariance"])
    return estimate_of(
        name=ideal.name,
        pose=ideal.pose,
        frame=_one_of(own["frame"], ("camera", "world")),
        covariance=covariance,
        information=np.asarray(np.linalg.inv(covariance), np.float64),
        unseen=np.zeros((0, 6)),
        words=(),
        length_scale=ideal.length_scale,
        body=ideal.body,
        camera=ideal.camera,
        of_camera=ideal.of_camera,
    )


def _name(document: Mapping[str, Any], kind: str) -> str:
    if kind == "fuse":
        return str(document["body"])
    if kind == "align":
        return Path(str(document["photograph"])).name
    return str(document["name"] if "name" in document else document["sensor"])


def _camera(document: Mapping[str, Any]) -> Intrinsics | None:
    if document.get("camera") is not None:
        return Intrinsics.from_dict(document["camera"])
    projection = document.get("projection")
    if projection is None:
        return None
    return Intrinsics(document["size"], projection["focal"], projection["centre"])


def _numbers(values: Any, shape: tuple[int, ...]) -> Array:
    """An array as `jsonable` wrote it, infinities and what is no number too."""
    array = np.array(values, dtype=np.float64)  # None is NaN, "inf" infinite
    if array.shape != shape:
        raise ValueError(f"an array has the shape {array.shape}, not {shape}")
    return array


def _symmetric(values: Any) -> Array:
    """A finite matrix (6, 6) that may be a covariance or an information."""
    matrix = _numbers(values, (6, 6))
    if not (np.abs(matrix) < _ABSURD).all():  # NaN is not either
        raise ValueError("a matrix has entries that are no numbers, or absurd ones")
    scale = np.sqrt(np.abs(np.diagonal(matrix)))
    if (np.abs(matrix - matrix.T) > _ROUNDING * np.outer(scale, scale)).any():
        raise ValueError("a matrix is not symmetric")
    return matrix


def _orthonormal(values: Any) -> Array:
    """Directions (q, 6)."""
    rows = _numbers(values, (len(values), 6)) if values else np.zeros((0, 6))
    if not ((np.abs(rows) < 2.0).all() and np.allclose(rows @ rows.T, np.eye(len(rows)), atol=_ROUNDING)):
        raise ValueError("the unobserved directions are no orthonormal ones")
    return rows


def _positive(value: Any) -> float:
    number = float(value)
    if not 1.0 / _ABSURD < number < _ABSURD:
        raise ValueError(f"the length scale is {value!r}")
    return number


def _one_of(value: Any, known: tuple[str, ...]) -> str:
    if value not in known:
        raise ValueError(f"the frame {value!r} is none of {', '.join(known)}")
    return str(value)
