"""Every exception and warning of the library, one sentence each.

All derive from `MitsubaCRBError`, so that the command catches one class, prints one line and exits
with code 2. A message says what was got, what was expected and what to change.
"""

from __future__ import annotations


class MitsubaCRBError(Exception):
    """Base class of everything that this library raises on purpose."""


class LLVMError(MitsubaCRBError):
    """No LLVM library that Dr.Jit can use was found, or the one named is too old."""


class VariantError(MitsubaCRBError):
    """Mitsuba is missing, or its variant is neither llvm_ad_rgb nor cuda_ad_rgb, or does not run here."""


class SceneError(MitsubaCRBError):
    """A scene cannot be read: file, plugin, property, texture, mesh or parameter is at fault."""


class SensorError(MitsubaCRBError):
    """A sensor does not exist, or is of a kind whose pose cannot be bounded."""


class CameraError(MitsubaCRBError):
    """Intrinsics or a lens cannot be used: of another image, a model that folds it over."""


class CaptureError(MitsubaCRBError):
    """A folder of posed photographs cannot be used: files are missing, or do not fit one another."""


class FieldError(MitsubaCRBError):
    """A splat or radiance field cannot be used: its file is damaged, or of another kind or version."""


class FilmError(MitsubaCRBError):
    """A film or its reconstruction filter does not measure linear RGB."""


class IntegratorError(MitsubaCRBError):
    """An integrator returns no radiance for a ray, or hides the camera's derivative from this method."""


class PoseError(MitsubaCRBError):
    """A pose is not a rigid motion, or cannot be parsed."""


class OptionError(MitsubaCRBError):
    """An option (spp, batches, size, tile, seed, method) has a value that cannot be used."""


class PixelsError(MitsubaCRBError):
    """A pixel selection is empty, malformed or of the wrong size."""


class NoiseError(MitsubaCRBError):
    """A noise model has impossible parameters, or does not match the image."""


class SaturatedError(NoiseError):
    """A noise model leaves no information in any pixel."""


class NuisanceError(MitsubaCRBError):
    """A nuisance parameter does not exist, has no derivative, or was named twice."""


class PriorError(MitsubaCRBError):
    """What is said to be known of a pose beforehand is no information matrix in a known frame."""


class TracingError(MitsubaCRBError):
    """Mitsuba, or a plugin of it, failed while the scene was traced."""


class PrecisionError(MitsubaCRBError):
    """The camera stands so far from the origin that float32 positions leave no number worth anything."""


class RadianceError(MitsubaCRBError):
    """The renderer returned radiance that is not finite."""


class CoordinatesError(MitsubaCRBError):
    """Coordinates of a pose do not exist, or are singular at this pose."""


class FrameError(MitsubaCRBError):
    """Matrices of different variables, frames or linearisation poses were mixed."""


class OutputError(MitsubaCRBError):
    """An output file cannot be written; checked before anything is rendered."""


class StoreError(MitsubaCRBError):
    """A store of views is missing, damaged, of other settings, or what reads it is not installed."""


class PlanError(MitsubaCRBError):
    """Views or a path cannot be planned: a view, a place, a budget, a limit or an odometry is at fault."""


class DocumentError(MitsubaCRBError):
    """A document is not what `to_dict` of this class writes: of another class or layout, or damaged."""


class ConfigError(MitsubaCRBError):
    """A team's file cannot be read, or has a key or a value that means nothing."""


class WorkerError(MitsubaCRBError):
    """A process that measures an agent ended before it had answered."""


class SelectionError(MitsubaCRBError):
    """Tiles cannot be chosen: a budget, a tile, an agent or the starting information is at fault."""


class FusionError(MitsubaCRBError):
    """Agents, relative poses or shared nuisances cannot be combined: a name or a matrix is at fault."""


class PointsError(MitsubaCRBError):
    """Points or their pixel noise cannot be used: too few, behind the camera, or no positive sigma."""


class MessageError(MitsubaCRBError):
    """A message is corrupt, does not fit its layout, or refers to another base."""


class AlignmentError(MitsubaCRBError):
    """A pose cannot be estimated from this image: its shape, its pixels or the start are at fault."""


class OutOfViewError(AlignmentError):
    """From the start pose the image does not depend on the pose."""


class TrialError(MitsubaCRBError):
    """Monte Carlo trials cannot be run, resumed or judged: their number, settings or bound are at fault."""


class FieldWarning(UserWarning):
    """Something of a splat or radiance field was left out, or its cameras seem to be of another frame."""


class SceneWarning(UserWarning):
    """Something of a scene was left out or replaced, or nothing of it is lit: it is measured nevertheless."""


class BlindSpotWarning(UserWarning):
    """A method cannot see some of the scene's image changes; the information is too small."""


class NuisanceWarning(UserWarning):
    """A nuisance parameter costs nothing, for the image does not see it, or so few paths do not tell what."""


class PrecisionWarning(UserWarning):
    """float32 rendering, or too few samples, limits what the number is worth."""
