"""Noise models in TOML, and estimated from residual images."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy import sparse

from mitsuba_crb import noise
from mitsuba_crb.errors import NoiseError

TENT = [[0.1, 0.2, 0.1], [0.2, 1.3, 0.2], [0.1, 0.2, 0.1]]
MODELS = [
    noise.Gaussian(0.1),
    noise.Clipped(0.1, 2.0),
    noise.PerChannel([0.1, 0.2, 0.3]),
    noise.ColourBlocks(np.eye(3) + 0.1),
    noise.Heteroscedastic([0.1, 0.2]),
    noise.SigmaPower(0.01, 2.0),
    noise.SigmaTable([1.0, 2.0, 5.0], [0.01, 0.02, 0.1]),
    noise.PoissonGaussian(0.01, 0.02),
    noise.StudentT(0.1, 3.0),
    noise.Laplace(0.1),
    noise.Stationary(TENT),
    noise.Luminance(noise.Gaussian(0.1), [0.0, 1.0, 0.0]),
    noise.Sensor(noise.Laplace(0.1), "before", noise.SRGB, 2.0, noise.Quantisation(16, -0.1, 2.0)),
    noise.Sensor(noise.Gaussian(0.1), "after", noise.Tabulated([0, 1, 2], [0, 2, 3])),
    noise.Sensor(noise.Gaussian(0.1), "after"),
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.to_dict()["model"])
def test_a_model_is_read_from_what_it_wrote(model):
    again = noise.from_dict(model.to_dict())
    assert type(again) is type(model)
    assert again.to_dict() == model.to_dict()


def test_the_documented_example_is_a_whole_camera(tmp_path):
    from mitsuba_crb.noise import schema

    example = re.search(r"For example:\n\n(.*?)\n\n`from_dict", schema.__doc__, re.DOTALL)[1]
    file = tmp_path / "camera.toml"
    file.write_text(re.sub(r"^ {4}", "", example, flags=re.MULTILINE))
    model = noise.load(file)
    assert model == noise.Sensor(
        noise.PoissonGaussian(0.001, 0.002), "before", noise.SRGB, 2.0, noise.Quantisation(256)
    )


def test_every_model_and_curve_can_be_written():
    from mitsuba_crb.noise import schema

    made = {make for make, _ in (schema.MODELS | schema.CURVES).values() if isinstance(make, type)}
    made |= {noise.Stationary, noise.Periodic}  # by functions, from either of two parameters
    kinds = {kind for kind in vars(noise).values() if isinstance(kind, type) and hasattr(kind, "to_dict")}
    assert made == {kind for kind in kinds if not vars(kind).get("_is_protocol")}


def test_whole_levels_are_read_from_what_was_written_of_a_float():
    model = noise.Sensor(noise.Gaussian(0.1), "after", quantisation=noise.Quantisation(16.0))
    assert noise.from_dict(model.to_dict()) == model


def test_arrays_come_from_files_beside_the_table(tmp_path):
    np.save(tmp_path / "map.npy", np.full((4, 5), 2.0))
    np.save(tmp_path / "modes.npy", np.ones((2, 4, 5)))
    np.save(tmp_path / "spectrum.npy", np.full((4, 5), 3.0))
    sparse.save_npz(tmp_path / "precision.npz", 2.0 * sparse.eye_array(20).tocsc())
    low_rank = 'model = "low_rank_plus_diagonal"\nvariance = "map.npy"\nmodes = "modes.npy"'
    tables = {
        'model = "per_pixel"\nvariance = "map.npy"': noise.PerPixel,
        low_rank: noise.LowRankPlusDiagonal,
        'model = "periodic"\npower_spectrum = "spectrum.npy"': noise.Periodic,
        'model = "sparse_precision"\nprecision = "precision.npz"\nshape = [4, 5]': noise.SparsePrecision,
    }
    for text, kind in tables.items():
        (tmp_path / "noise.toml").write_text(f"[noise]\n{text}\n")
        model = noise.load(tmp_path / "noise.toml")
        assert isinstance(model, kind)
        model.check(4, 5, 3)


def test_arrays_that_are_none_of_real_numbers_are_named_with_their_files(tmp_path):
    """Indices beyond a sparse matrix would crash what uses them."""
    beyond = 2.0 * sparse.eye_array(20).tocsc()
    beyond.indices[3] = 1_000_000
    sparse.save_npz(tmp_path / "beyond.npz", beyond)
    np.save(tmp_path / "complex.npy", np.full((4, 5), 1j))
    np.save(tmp_path / "words.npy", np.array([["1"]]))
    for name in ("complex.npy", "words.npy"):
        with pytest.raises(NoiseError, match=f"{name} is no .npy file of real numbers"):
            noise.from_dict({"model": "per_pixel", "variance": name}, folder=tmp_path)
    table = {"model": "sparse_precision", "precision": "beyond.npz", "shape": [4, 5]}
    with pytest.raises(NoiseError, match=r"beyond.npz is no .npz file of a sparse matrix: indices"):
        noise.from_dict(table, folder=tmp_path)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"model": "gausian", "sigma": 1}, "an unknown model 'gausian'; did you mean 'gaussian'?"),
        ({"model": "gaussian", "sgima": 1}, "[noise] has an unknown key 'sgima'; did you mean 'sigma'?"),
        ({"model": "gaussian"}, "[noise] has no sigma"),
        ({"modle": "gaussian"}, "needs model, not modle = one of gaussian, per_channel"),
        ({}, "needs model = one of gaussian, per_channel"),
        ({1: "gaussian"}, "needs model = one of gaussian"),
        ({"model": "gaussian", "sigma": 1, 1: 2}, "[noise] has an unknown key 1; known are model, sigma"),
        ({"model": "gaussian", "xyz": 1}, "[noise] has an unknown key 'xyz'; known are model, sigma"),
        ([], "noise must be a table, not []"),
        ({"model": "gaussian", "sigma": True}, "[noise]: sigma must be a number, not True"),
        ({"model": "gaussian", "sigma": "0.1"}, "[noise]: sigma must be a number, not '0.1'"),
        ({"model": "gaussian", "sigma": float("nan")}, "[noise]: sigma must be positive and finite"),
        ({"model": "per_channel", "sigmas": [1.0, True]}, "entry 2 of sigmas must be a number, not True"),
        ({"model": "per_channel", "sigmas": 1.0}, "sigmas must be a list, not 1.0"),
        ({"model": "per_pixel", "variance": [[1.0, True]]}, "variance must be nested lists of numbers or"),
        ({"model": "per_pixel", "variance": [["1"]]}, "variance must be nested lists of numbers or"),
        ({"model": "per_pixel", "variance": [[1.0], [1.0, 2.0]]}, "variance must be nested lists of numbers"),
        ({"model": "per_pixel", "variance": [[-1.0]]}, "[noise]: 1 of 1 variances are zero, negative or NaN"),
        (
            {"model": "luminance", "noise": {"model": "gaussian", "sigma": -1}},
            "[noise.noise]: sigma must be positive",
        ),
        (
            {"model": "luminance", "noise": {"model": "gaussian", "sgima": 1}},
            "[noise.noise] has an unknown key 'sgima'; did you mean 'sigma'?",
        ),
        (
            {"model": "sparse_precision", "precision": 1, "shape": [4, True]},
            "shape must be height and width in whole pixels, not [4, True]",
        ),
        (
            {"model": "sensor", "noise": {"model": "laplace", "scale": 1}, "noise_at": "behind"},
            "noise_at must be 'before' or 'after', not 'behind'",
        ),
        ({"model": "luminance", "noise": 0.1}, "[noise]: noise must be a table, not 0.1"),
        ({"model": "per_pixel", "variance": "no.npy"}, "cannot read no.npy"),
        ({"model": ["gaussian"]}, "unknown model ['gaussian']; did you mean 'gaussian'?"),
        ({"model": "gaussian", "sigma": 10**400}, "sigma must be a number, not 1000"),
        ({"model": "gaussian", "sigma": [0.1]}, "sigma must be a number, not [0.1]"),
        ({"model": "heteroscedastic", "coefficients": [10**400]}, "entry 1 of coefficients must be a number"),
        ({"model": "stationary"}, "either autocovariance or power_spectrum"),
        (
            {
                "model": "sensor",
                "noise": {"model": "laplace", "scale": 1},
                "noise_at": "after",
                "curve": {"curve": "sgrb"},
            },
            "[noise.curve] has an unknown curve 'sgrb'; did you mean 'srgb'?",
        ),
        (
            {
                "model": "sensor",
                "noise": {"model": "laplace", "scale": 1},
                "noise_at": "after",
                "quantisation": {"level": 4},
            },
            "[noise.quantisation] has an unknown key 'level'; did you mean 'levels'?",
        ),
        (
            {
                "model": "sensor",
                "noise": {"model": "laplace", "scale": 1},
                "noise_at": "after",
                "quantisation": {"levels": [4]},
            },
            "[noise.quantisation]: levels must be a whole number, not [4]",
        ),
    ],
)
def test_mistakes_are_named_with_what_is_near(table, message):
    with pytest.raises(NoiseError, match=re.escape(message)) as caught:
        noise.from_dict(table)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"model": "gaussian", "sigma": "2 DN"}, "sigma"),
        ({"model": "gaussian", "sigma": "1%"}, "sigma"),
        ({"model": "per_channel", "sigmas": [0.1, "-40 dB"]}, "entry 2 of sigmas"),
        ({"model": "poisson_gaussian", "gain": "0.5 DN/e-", "read_noise": 0.1}, "gain"),
        ({"model": "poisson_gaussian", "gain": 0.1, "read_noise": "2e-"}, "read_noise"),
        ({"model": "luminance", "noise": {"model": "laplace", "scale": "1 DN"}}, "scale"),
    ],
)
def test_units_are_refused_with_the_scale_that_numbers_are_on(table, key):
    with pytest.raises(NoiseError) as caught:
        noise.from_dict(table)
    message = str(caught.value)
    assert f"{key} must be a number, not '" in message
    assert "radiance on the film's scale" in message
    assert "model = 'sensor' with noise_at = 'after', its curve (srgb) and codes / 255" in message
    assert "\n" not in message


def test_srgb_is_called_so_and_no_other_power_is():
    for curve, words in ((noise.SRGB, "after an srgb curve"), (noise.Power(2.2), "after a power curve")):
        sensor = noise.Sensor(noise.Gaussian(0.1), "after", curve)
        assert sensor.description.endswith(words)
        assert noise.from_dict(sensor.to_dict()) == sensor
    spelt_out = noise.Power(2.4, 0.0031308, 0.055)
    assert spelt_out.to_dict() == {"curve": "srgb"}


@pytest.mark.parametrize(
    ("text", "message"),
    [("[noise", "is no TOML"), ("[noize]", "did you mean 'noise'?"), ("", "[noise] needs model = one of")],
)
def test_files_that_are_none_are_named(tmp_path, text, message):
    (tmp_path / "noise.toml").write_text(text)
    with pytest.raises(NoiseError, match=re.escape(message)):
        noise.load(tmp_path / "noise.toml")
    with pytest.raises(NoiseError, match="cannot read"):
        noise.load(tmp_path / "nowhere.toml")


class TestEstimate:
    """From simulated residuals of known variance; z-scores over runs show that the errors are right."""

    mean = np.linspace(0.0, 2.0, 8 * 10 * 3).reshape(8, 10, 3)

    def _z(self, by, variance, truth, **options):
        rng = np.random.default_rng(3)
        z = []
        for _ in range(200):
            residuals = rng.normal(size=(20, *self.mean.shape)) * np.sqrt(variance)
            found = noise.estimate_noise(residuals, by=by, **options)
            z.append((found.estimate - truth) / found.standard_error)
        return np.array(z)

    def test_per_channel(self):
        variance = np.array([0.5, 1.0, 2.0])
        z = self._z("channel", variance, variance)
        assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(200)
        # 200 runs know a standard deviation to 5 %.
        np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.2)

    def test_as_a_function_of_intensity(self):
        z = self._z("intensity", 0.2 + 0.5 * self.mean, np.array([0.2, 0.5]), mean=self.mean)
        assert np.abs(z.mean(axis=0)).max() < 0.3
        np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.2)

    def test_per_pixel_and_about_the_own_mean(self):
        variance = 0.2 + self.mean
        rng = np.random.default_rng(5)
        images = rng.normal(size=(400, *self.mean.shape)) * np.sqrt(variance)
        found = noise.estimate_noise(images - images.mean(axis=0), by="pixel", ddof=1)
        z = (found.estimate - variance) / found.standard_error
        assert abs(z.mean()) < 0.3
        assert abs(z.std() - 1.0) < 0.2
        np.testing.assert_array_equal(found.model.variance, found.estimate)
        np.testing.assert_allclose(found.estimate, images.var(axis=0, ddof=1), rtol=1e-12)

    @pytest.mark.parametrize(
        ("residuals", "options", "message"),
        [
            (np.ones((3, 4)), {"by": "pixel"}, "shape"),
            (np.zeros((2, 2, 2, 3)), {"by": "pixel"}, "zero"),
            (np.ones((1, 2, 2, 3)), {"by": "pixel", "ddof": 1}, "leaves nothing"),
            (np.full((2, 2, 2, 3), np.nan), {"by": "channel"}, "24 residuals are not finite"),
            (np.ones((2, 2, 2, 3)), {"by": "intensity"}, "needs mean"),
            (np.ones((2, 2, 2, 3)), {"by": "intensity", "mean": np.ones((2, 2))}, "the mean has shape"),
            (np.ones((2, 2, 2, 3)), {"by": "intensity", "mean": np.ones((2, 2, 3))}, "different intensities"),
            (np.ones((2, 2, 2, 3)), {"by": "colour"}, "'pixel', 'channel' or 'intensity'"),
        ],
    )
    def test_bad_input_is_named(self, residuals, options, message):
        with pytest.raises(NoiseError, match=message):
            noise.estimate_noise(residuals, **options)
