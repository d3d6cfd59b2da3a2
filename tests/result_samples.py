"""Results of every class, small, with what is hard to write: infinities, empty arrays, frames, priors."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import synthetic_view
from rigs import about, definite, made, noisy, random_pose

from mitsuba_crb import message, se3
from mitsuba_crb.agents.bundle import PointView, joint_point_information, point_information
from mitsuba_crb.agents.covariance_intersection import covariance_intersection
from mitsuba_crb.agents.fusion import Agent, fuse
from mitsuba_crb.agents.information_filter import InformationFilter
from mitsuba_crb.agents.pose_graph import PoseGraph, RelativePose
from mitsuba_crb.agents.selection import select_tiles
from mitsuba_crb.agents.shared_nuisance import map_error
from mitsuba_crb.agents.tiles import Budget, TileInformation
from mitsuba_crb.bound.consistency import consistency
from mitsuba_crb.bound.coordinates import to_coordinates
from mitsuba_crb.bound.cramer_rao import PoseBound, cramer_rao_bound, joint_bound
from mitsuba_crb.bound.hcr import hammersley_chapman_robbins
from mitsuba_crb.bound.misspecified import misspecified_covariance
from mitsuba_crb.bound.prior import prior_from_dict
from mitsuba_crb.camera import Camera, Intrinsics
from mitsuba_crb.datasets.photographs import Capture, Photograph
from mitsuba_crb.datasets.pictures import Comparable, Picture
from mitsuba_crb.datasets.pose_list import Poses
from mitsuba_crb.errors import PrecisionWarning
from mitsuba_crb.estimate.align import Alignment
from mitsuba_crb.estimate.photograph import Candidate, PhotographAlignment
from mitsuba_crb.estimate.renderer_part import renderer_part
from mitsuba_crb.estimate.tracks import FeatureTracks
from mitsuba_crb.estimate.trial import Trial
from mitsuba_crb.estimate.trials import Validation
from mitsuba_crb.files import Record
from mitsuba_crb.information.accumulate import Sums
from mitsuba_crb.information.fisher import FisherInformation
from mitsuba_crb.information.image_jacobian import ImageJacobian
from mitsuba_crb.information.joint import JointInformation, joint_information
from mitsuba_crb.information.linearisation import PixelSelection
from mitsuba_crb.information.significance import no_information
from mitsuba_crb.measure.check import JacobianCheck, MethodCheck
from mitsuba_crb.measure.diagnosis import Diagnosis, Row
from mitsuba_crb.measure.held_out import HeldOut
from mitsuba_crb.measure.pictures import pictures_of
from mitsuba_crb.measure.pose_table import PoseTable
from mitsuba_crb.measure.report import BoundReport
from mitsuba_crb.measure.teams import TeamFusion, TeamSelection
from mitsuba_crb.measure.tone import Tone
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.noise.residuals import residual_covariance
from mitsuba_crb.planning.candidates import Candidates
from mitsuba_crb.planning.next_view import NextViews
from mitsuba_crb.planning.odometry import Odometry
from mitsuba_crb.planning.path_search import PathPlan


def samples() -> Iterator[Record]:
    """Some of each class; the kinds of one class that are written differently, too."""
    for made_of in (
        _calibrations,
        _informations,
        _jacobians,
        _bounds,
        _agents,
        _messages,
        _trials,
        _plans,
        _findings,
    ):
        rng = np.random.default_rng(sum(made_of.__name__.encode()))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PrecisionWarning)
            yield from made_of(rng)


def _calibrations(rng: np.random.Generator) -> Iterator[Record]:
    yield Intrinsics((640, 480), (525.0, 525.5), (320.0, 240.0))
    yield Intrinsics((640, 480), (525.0, 525.5), (320.0, 240.0), "fisheye", tuple(rng.normal(size=4)))
    poses = np.array([random_pose(rng) for _ in range(3)])
    camera = Intrinsics((4, 3), (5.0, 5.0), (2.0, 1.5))
    photographs = tuple(Photograph("a", "a.png", camera, pose, "mask.png") for pose in poses)
    yield photographs[0]
    points, colours = rng.normal(size=(4, 3)), rng.integers(0, 256, (4, 3)).astype(np.uint8)
    yield Capture(photographs, (1, 2), (0,), "every 8th", "COLMAP", "camera_from_world", points, colours)
    yield Capture(photographs, (0, 1, 2), (), "all", "LLFF", "world_from_camera", notes=("no points",))
    yield Poses(poses, ("a", "b", "c"), "TUM", "world_from_camera", ("1", "1", "2"), ("off by 1e-4",))


def information(rng: np.random.Generator, *, rank: int = 6, **changes: Any) -> FisherInformation:
    """An uncertain one, far from the world's origin."""
    matrix, covariance = noisy(rng, definite(rng, rank), error=1e-3)
    about_what = {"variable": "body", "pose": random_pose(rng, origin=1e5), "length_scale": np.pi} | changes
    return made(matrix, covariance, 1.01 * matrix, **about_what)


def _informations(rng: np.random.Generator) -> Iterator[Record]:
    found = information(rng)
    yield found
    yield found.to_frame("world")
    yield made(np.eye(6), frame="world")
    yield dataclasses.replace(found, plain_matrix=None)
    yield found.linearisation
    yield PixelSelection("random", 100, 10, "random:0.1")


def with_nuisances(rng: np.random.Generator) -> ImageJacobian:
    """Of a view whose gain and black level are unknown."""
    view = synthetic_view.jacobian(16, 12)
    shape = (*view.batch_values.shape[:-1], 2)
    more = rng.normal(size=shape[1:]) + 0.1 * rng.normal(size=shape)
    return dataclasses.replace(
        view,
        batch_values=np.concatenate([view.batch_values, more], axis=-1),
        parameters=("gain", "black"),
        provenance={
            "scene": "inf",
            "defines": {"type": "nan", "x": "-inf"},
            "noise_inflation": np.inf,
            "variance": np.array([[1.5, np.nan]], dtype=np.float32),
            "by number": {0: None, 1: [True, {}]},
        },
    )


def _jacobians(rng: np.random.Generator) -> Iterator[Record]:
    view = synthetic_view.jacobian(8, 10, fraction=0.5, kind="random")
    yield view
    yield view.to_frame("world")
    yield view.only(np.zeros((8, 10), dtype=bool))
    single = np.asarray(view.batch_values, dtype=np.float32)
    yield dataclasses.replace(view, batch_values=single, pixels=view.pixels.astype(np.uint16))
    joint = joint_information(with_nuisances(rng), Gaussian(0.1))
    yield with_nuisances(rng)
    yield joint
    yield per_tile(rng).marginalize("gain").fix("black:8")
    yield pictures_of(view, information(rng))


def per_tile(rng: np.random.Generator) -> JointInformation:
    """With a nuisance that has a value in every tile."""
    F = {count: rng.normal(size=(count, count)) for count in (7, 28)}
    sums = Sums(F[7] @ F[7].T, F[28] @ F[28].T, F[7] @ F[7].T, 0.01 * F[7] @ F[7].T)
    per = {frozenset(): sums, frozenset({"black:8"}): sums, frozenset({"black:8", "type"}): sums}
    return JointInformation(sums=per, parameters=("gain",), per_tile=("black:8",), linearisation=about())


def bounds(rng: np.random.Generator) -> dict[str, PoseBound]:
    """In both frames, with every kind of prior, of what is unseen, and among nuisances."""
    found, near = information(rng), information(rng, pose=random_pose(rng))
    stds = prior_from_dict({"frame": "world", "position_std": 0.1})
    joint = joint_information(with_nuisances(rng), Gaussian(0.1)).marginalize()
    return {
        "plain": cramer_rao_bound(found),
        "world": cramer_rao_bound(found).to_frame("world"),
        "of a world information": cramer_rao_bound(found.to_frame("world")),
        "rank 4": cramer_rao_bound(information(rng, rank=4)),
        "nothing": cramer_rao_bound(no_information(variable="body", pose=np.eye(4))),
        "prior file": cramer_rao_bound(found, prior=stds),
        "prior matrix": cramer_rao_bound(near.to_frame("world"), prior=np.diag([10.0, 0, 0, 0, 0, 0])),
        "prior information": cramer_rao_bound(found, prior=dataclasses.replace(found, matrix=np.eye(6))),
        "nuisances": joint_bound(joint, prior=stds),
    }


def _bounds(rng: np.random.Generator) -> Iterator[Record]:
    found = bounds(rng)
    yield from found.values()
    yield from (to_coordinates(bound, "centre_rotation") for bound in found.values())
    table = PoseTable.of(list(found.values()))
    yield from table.rows
    yield table
    twists = 1e-3 * rng.normal(size=(3, 6))
    hcr = hammersley_chapman_robbins(found["rank 4"].information, twists, np.eye(3), rng.normal(size=(3, 6)))
    yield hcr
    yield consistency(rng.normal(size=(9, 6)), found["world"].information)
    yield prior_from_dict({"frame": "world", "position_std": 0.1})
    yield prior_from_dict({"frame": "camera", "covariance": np.linalg.inv(definite(rng)).tolist()})
    residuals = residual_covariance(rng.normal(size=(2, 12, 14, 3)))
    yield residuals
    for view in (synthetic_view.jacobian(16, 12), synthetic_view.jacobian(16, 12, unseen=(2,))):
        yield misspecified_covariance(view, Gaussian(0.1), residuals)
    yield BoundReport(found["world"], None, None)
    yield BoundReport(found["plain"], hcr, pictures_of(synthetic_view.jacobian(8, 10), information(rng)))


def _agents(rng: np.random.Generator) -> Iterator[Record]:
    pose, names = random_pose(rng), ("inf", "type")
    agents = [Agent(name, information(rng, pose=pose), np.eye(4)) for name in names]
    yield agents[0]
    fusion = fuse(agents)
    yield fusion
    yield fusion.agents[0]
    blocks = np.array([definite(rng) for _ in range(4)])
    tiles = [
        TileInformation(
            agent=name,
            tiles=np.tile([0, 0, 8, 8], (4, 1)),
            select=blocks,
            report=-blocks,
            cost_bytes=np.full(4, 100),
            linearisation=about(variable="body"),
        )
        for name in names
    ]
    yield tiles[0]
    budget = Budget(tiles=3, tiles_per_agent={"type": 2, "inf": 1}, bytes_per_agent=300)
    selection = select_tiles(tiles, budget)
    assert selection.value_heldout == -np.inf
    yield Budget()
    yield budget
    yield selection
    yield TeamFusion(fusion, (fusion.bound,), ("one thing",))
    image = rng.random((4, 5, 3), dtype=np.float32)
    yield TeamSelection(selection, ((1, selection), (3, selection)), "tiles", tuple(tiles), (image,), ())
    common = [agent.information for agent in agents]
    yield covariance_intersection(common)
    poses = [information(rng, variable=name) for name in "ab"]
    link = RelativePose("a", "b", definite(rng, 3))
    yield link
    yield PoseGraph(poses, [link]).gauges[0]
    yield map_error("map", poses, np.diag([1.0, 0, 0, 0, 0, 0]), world_from_map=pose)
    camera = Camera.pinhole((500.0, 510.0), (320.0, 240.0), (640, 480))
    points = np.array([[0.1, 0.2, 4.0], [1.0, -0.5, 5.0], [-0.7, 0.3, 6.0], [0.4, -0.9, 4.5]])
    view = PointView("left", se3.exp([0.1, 0, 0, 0, 0.02, 0]), camera, 0.5)
    yield view
    some = dataclasses.replace(
        view, variable="right", noise=np.array([0.5, 1.0, 2.0]), seen=np.array([0, 2, 3])
    )
    yield some
    yield joint_point_information(points, [view, some])
    yield FeatureTracks(
        points, points[:, :2], np.zeros((4, 2), dtype=np.int64), np.eye(4, dtype=bool), view,
        point_information(points, view),
    )  # fmt: skip


def _messages(rng: np.random.Generator) -> Iterator[Record]:
    found = information(rng)
    receiver = InformationFilter(no_information(variable="body", pose=found.pose))
    whole = message.encode(found.to_frame("world"), agent="a", sequence=1, tile=(0, 0, 8, 8))
    base = message.decode(whole)
    yield base
    yield message.decode(message.encode(found, agent="b", sequence=2, form="sketch", rank=2))
    more = dataclasses.replace(found, matrix=1.1 * found.matrix)
    receiver.receive(whole)
    yield receiver.receive(message.encode(more, agent="a", sequence=2, tile=(0, 0, 8, 8), base=base))
    yield from receiver.contributions


def _trials(rng: np.random.Generator) -> Iterator[Record]:
    bound = cramer_rao_bound(information(rng))
    errors = 1e-3 * rng.normal(size=(8, 6))
    added = (0.0,) * 21
    trials = tuple(
        Trial(k, "converged", tuple(e), 1.0, 5, 0.1, added, 0) for k, e in enumerate(errors.tolist())
    )
    lost = Trial(8, "diverged", (np.nan,) * 6, np.inf, 1, np.nan, (np.nan,) * 21, 3)
    yield lost
    judged = renderer_part(errors, bound.information, 1e-8 * np.eye(6))
    yield judged
    yield Validation(
        settings={"sigma": 0.01, "size": [4, 5], "defines": {}},
        trials=(*trials, lost),
        failed=(8,),
        bound=bound,
        consistency=consistency(errors, bound.information),
        rmse_position=0.1,
        rmse_rotation_deg=0.2,
        bound_position=0.3,
        bound_rotation_deg=np.inf,
        renderer=judged,
        further=(dataclasses.replace(lost, index=9),),
    )
    yield from _photographs(rng)


def _photographs(rng: np.random.Generator) -> Iterator[Record]:
    yield Picture("a.jpg", rng.random((4, 5, 3)), np.ones((4, 5)))
    yield from (found := alignment(rng)).candidates
    yield from (found.alignment, found.measured, found.alignment.tone, found)
    assert found.held_out is not None
    yield found.held_out
    alone = dataclasses.replace(found.alignment, status="diverged", misspecified=None, tone=Tone("known"))
    yield dataclasses.replace(found, alignment=alone, held_out=None, display=True)


def alignment(rng: np.random.Generator) -> PhotographAlignment:
    """Of a photograph with saturated pixels, from two starts, beside photographs held out."""
    view = with_nuisances(rng)
    residuals = rng.normal(size=(2, 16, 12, 3))
    beside = misspecified_covariance(view, Gaussian(0.1), residual_covariance(residuals))
    values = 0.5 * view.image
    values[:2, :3] = np.nan
    pose = view.pose
    found = Alignment(
        pose=pose,
        status="converged",
        residual=1.0,
        iterations=12,
        bound=beside.ideal,
        excess=0.1,
        added=np.eye(6),
        masked=6,
        invalid=2,
        tone=Tone("channels", np.array([1.3, 1.2, 1.1]), np.array([0.05, 0.04, 0.03])),
        rms=0.1,
        noise={"model": "gaussian", "sigma": 0.1, "description": "Gaussian, sigma = 0.1", "origin": "given"},
        image=values + 0.05 * rng.normal(size=values.shape),
        misspecified=beside,
    )
    near = Candidate("near.jpg", pose @ se3.exp([0.1, 0, 0, 0, 0.1, 0]), pose, "converged", 0.11)
    far = Candidate("far.jpg", np.eye(4), np.eye(4), "diverged", np.inf)
    settings = {
        "scene": "scenes/relief/relief.xml",
        "photograph": "photo.jpg",
        "photograph_size": [24, 32],
        "size": [12, 16],
        "noise": "held out",
        "levels": 1,
        "estimator": "levenberg_marquardt",
        "spp": 64,
    }
    noise = 1e-4 * np.tile(np.eye(3), (2, 1, 1))
    held_out = HeldOut(("a", "b"), tuple(residuals), noise, (found.tone, found.tone))
    measured = Comparable(values, 4, 2)
    return PhotographAlignment(found, (near, far), measured, False, 28.0, 12.0, held_out, settings)


def _plans(rng: np.random.Generator) -> Iterator[Record]:
    poses, bounds = np.array([random_pose(rng) for _ in range(2)]), np.array([np.inf, 0.1, 0.1 / 3.0])
    yield NextViews(
        objective="lambda_min",
        have=(),
        chosen=(7, 2),
        poses=poses,
        position_bound=bounds,
        position_bound_standard_error=0.1 * bounds,
        rotation_bound_deg=bounds,
        rotation_bound_deg_standard_error=np.array([np.nan, 0.1, 0.2]),
        rank=(0, 5, 6),
        value=3.0,
        value_empty=1.0,
        upper_bound=5.0,
        certificate=0.5,
        guarantee=None,
        usable=12,
        body=poses[0],
        length_scale=2.0,
        ridge=1.0,
    )
    numbers = np.array([0, 3])
    yield Candidates(poses, numbers, numbers, np.array([0.0, 1.0, 0.0]), {"kind": "grid", "pitch": [0.0]})
    odometry = Odometry(0.05, 1.0 / 3.0)
    yield odometry
    found = PathPlan(
        start=0,
        goal=3,
        limit=0.1,
        odometry=odometry,
        places=(0, 3),
        views=(1, 12),
        poses=poses,
        length=2.0,
        shortest=2.0,
        before=np.array([np.nan, 0.09]),
        after=np.array([0.05, 0.04]),
        smallest_limit=0.09,
        dropped=0,
        length_lower_limit=2.0,
        dropped_below=0,
        neighbourhood="places of the grid around each",
    )
    yield found
    nothing = {"places": (), "views": (), "poses": poses[:0], "before": np.empty(0), "after": np.empty(0)}
    yield dataclasses.replace(found, odometry=None, length=np.inf, smallest_limit=np.inf, **nothing)


def _findings(rng: np.random.Generator) -> Iterator[Record]:
    numbers = np.array([1.0, np.nan, 0.1 + 0.2, -0.0, np.inf, 5e-324])
    row = MethodCheck("flow", numbers, numbers, numbers, numbers, numbers, numbers > 1.0, np.inf)
    yield row
    yield JacobianCheck((row, row), np.inf, rng.normal(size=6), 0.15, 512, 64)
    yield Diagnosis((Row("Python", "3.11", True), Row("LLVM", "none", False)))
