"""Names that programs and people give to the parts of a camera, in lower-case letters and digits."""

from __future__ import annotations

import re

# The first are written here and by ROS and OpenCV; in OpenCV's stereo sample the left camera has M1 and D1.
MATRIX = (
    "cameramatrix", "k", "mtx", "m", "intrinsicmatrix", "intrinsicsmatrix", "cameraintrinsics", "intrinsics",
    "cameraintrinsic", "intrinsic", "camintrinsics", "cammatrix", "cammtx", "cameramtx", "kmatrix", "kmat",
    "matrix", "intrinsicmat", "intrinsicparameters", "calibrationmatrix", "intrinsicparams", "camerak",
    "cameramat", "kk", "m1", "cm", "intrinsicmtx", "camk", "camintr",
)  # fmt: skip
COEFFICIENTS = (
    "distortioncoefficients", "distcoeffs", "distcoeff", "distcoefs", "distcoef", "distortioncoeffs",
    "distortioncoeff", "distortioncoefs", "distortioncoef", "distortioncoefficient", "distcoefficients",
    "distortion", "distortions", "dist", "d", "kc", "coefs", "coeffs", "coef", "coefficients",
    "distortionparameters", "distortionparams", "distparams", "distortionvector", "distortionmatrix",
    "distvec", "lensdistortion", "cameradistortion", "distmtx", "distmatrix", "camdist", "disto", "distcof",
    "distcoffs", "distortioncoefficents", "distortionvalues", "opencvdistortion", "d1",
)  # fmt: skip
ENTRIES = (
    ("fx", "flx", "focalx", "fu", "focallengthx"),
    ("fy", "fly", "focaly", "fv", "focallengthy"),
    ("cx", "ppx", "u0", "pu", "principalpointx"),
    ("cy", "ppy", "v0", "pv", "principalpointy"),
)
FOCAL = ("focallength", "focallengths", "focal", "focalpx", "focallengthpx")  # of both axes, or one for both
CENTRE = ("principalpoint", "principlepoint", "opticalcenter", "princpt", "imagecenter")
RADIAL = ("radialdistortion", "radial", "radialcoefficients", "radialdistortioncoefficients", "radialcoeffs")
TANGENTIAL = (
    "tangentialdistortion", "tangential", "tangentialcoefficients", "tangentialdistortioncoefficients",
    "tangentialcoeffs",
)  # fmt: skip
WIDTH = (
    "imagewidth", "width", "w", "imgwidth", "imgw", "framewidth", "resolutionx", "imgsizex", "resx",
)  # fmt: skip
HEIGHT = (
    "imageheight", "height", "h", "imgheight", "imgh", "frameheight", "resolutiony", "imgsizey", "resy",
)  # fmt: skip
SIZE = (
    "imagesize", "imgsize", "resolution", "size", "dim", "dims", "imageresolution", "imagedimensions",
    "dimensions", "framesize", "calibdimension", "cameraresolution", "imsize", "calibrationresolution",
    "capturedimagesize",
)  # fmt: skip
SHAPE = ("imageshape", "imgshape", "shape")  # NumPy's: height and width
NAME = ("cameraname",)

# Keys whose text names the distortion model; an unknown word is refused in the first, ignored in the others.
MODEL = ("distortionmodel", "distmodel", "distortiontype", "disttype", "distortion")
KIND = (
    "cameramodel", "calibrationmodel", "opencvmodel", "model", "cameratype", "projection", "projectionmodel",
    "lensmodel", "lenstype", "modeltype", "type", "calibrationtype", "projectiontype", "lens",
)  # fmt: skip
FISHEYE = ("fisheyemodel", "fisheye", "isfisheye", "usefisheye", "useopencvfisheye")  # true or false
UNKNOWN = "unknown"
# What the words mean, the first that is found; "" says nothing that a coefficient could contradict.
_WORDS = (
    (r"inverse|fov|atan|division|ocam|scaramuzza|thinprismfisheye|cahv|splined|ftheta|orthogr|stereogr|equisolid"
     r"|equirect|spheric|cylind|panoram", UNKNOWN),
    (r"doublesphere|^ds$", "double_sphere"),
    (r"eucm|extendedunified", "eucm"),
    (r"omni|mei$|unified", "omnidir"),
    (r"fisheye|kannala|^kb\d?$|equidist|^equi$", "equidistant"),
    (r"rational", "rational_polynomial"),
    (r"thinprism", "thin_prism"),
    (r"^tilted", "tilted"),
    (r"^rich$", "rich"),
    (r"plumb|radtan|radialtang|brown|conrady|radial|polynom|standard", "plumb_bob"),
    (r"^pinhole|perspective|^normal$|^opencv$|^cv2$|^regular$|^cv2calibratecamera$", "pinhole"),
)  # fmt: skip
ALIKE = ("plumb_bob", "rational_polynomial", "thin_prism", "tilted", "pinhole")

# Names of numbers that may be a distortion, and of some that are none.
SUSPECT = re.compile(r"dist(?!an|rib)|^kc|coef|radial|tangent")
SUSPECT_NUMBER = re.compile(r"[kps]\d|xi|kc\d")
HARMLESS = re.compile(
    r"std|err|undist|newcam|uncert|sigma|limit|rms|perview|roi|optimal|thresh|flag|aspect|fix|rect|^est|valid"
)
NO_LIST = re.compile(
    r"roi|quat|rot|^q\d?$|rect|crop|box|board|pattern|size|color|time|pose|trans|orient|^[rtp]\d?$"
)
LENGTHS = (4, 5, 8, 12, 14)


def plain(name: str) -> str:
    """A name in lower-case letters and digits, spelt rightly."""
    letters = re.sub(r"[^a-z0-9]", "", name.lower())
    return letters.replace("distors", "distort").replace("coefficent", "coefficient")


def means(word: str) -> str | None:
    """ROS's name of the distortion model that a word names, ``unknown``, or None if it names none."""
    return next((model for pattern, model in _WORDS if re.search(pattern, plain(word))), None)
