"""Names that programs and people give to the parts of a camera, in lower-case letters and digits."""

from __future__ import annotations

import re

# Of the images as they were taken, where a file has the matrix of undistorted ones as well.
ORIGINAL = (
    "cammatrixoriginal", "cameramatrixoriginal", "originalcameramatrix", "originalcammatrix", "koriginal",
    "korig", "originalk", "mtxoriginal", "kraw", "rawk", "cameramatrixraw", "kdistorted",
)  # fmt: skip
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
    "cameradistcoeffs", "camdistcoeffs", "cameradistcoeff", "camdistcoeff", "cameradistortioncoefficients",
    "lensdistortioncoefficients", "distortioncoeficients", "distcoefficient",
)  # fmt: skip
ENTRIES = (
    ("fx", "flx", "focalx", "fu", "focallengthx", "fxpx", "focallengthxpx"),
    ("fy", "fly", "focaly", "fv", "focallengthy", "fypx", "focallengthypx"),
    ("cx", "ppx", "u0", "pu", "principalpointx", "cxpx", "focalcenterxpx"),
    ("cy", "ppy", "v0", "pv", "principalpointy", "cypx", "focalcenterypx"),
)
# Of both axes, or one for both.
FOCAL = ("focallength", "focallengths", "focal", "focalpx", "focallengthpx", "f")
CENTRE = ("principalpoint", "principlepoint", "opticalcenter", "princpt", "imagecenter", "c")
ASPECT = ("aspectratio", "pixelaspectratio", "pixelratio", "pixelaspect")
RADIAL = ("radialdistortion", "radial", "radialcoefficients", "radialdistortioncoefficients", "radialcoeffs")
TANGENTIAL = (
    "tangentialdistortion", "tangential", "tangentialcoefficients", "tangentialdistortioncoefficients",
    "tangentialcoeffs",
)  # fmt: skip
WIDTH = (
    "imagewidth", "width", "w", "imgwidth", "imgw", "framewidth", "resolutionx", "imgsizex", "resx",
    "widthpx",
)  # fmt: skip
HEIGHT = (
    "imageheight", "height", "h", "imgheight", "imgh", "frameheight", "resolutiony", "imgsizey", "resy",
    "heightpx",
)  # fmt: skip
SIZE = (
    "imagesize", "imgsize", "resolution", "size", "dim", "dims", "imageresolution", "imagedimensions",
    "dimensions", "framesize", "calibdimension", "cameraresolution", "imsize", "calibrationresolution",
    "capturedimagesize",
)  # fmt: skip
SHAPE = ("imageshape", "imgshape", "shape", "grayshape", "frameshape")  # NumPy's: height and width
# Of all numbers in one list: fx, fy, cx, cy, and the coefficients.
PARAMETERS = (*MATRIX, "calibration", "calib", "cameraparams", "cameraparameters")
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
SUSPECT_NUMBER = re.compile(r"[kps]\d|xi|kc\d")  # of the plain name, whole
SUSPECT_WORD = re.compile(r"(?:^|[\W_])[kp]_?[1-6](?:[\W_]|$)", re.IGNORECASE)  # of the name as it is
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
