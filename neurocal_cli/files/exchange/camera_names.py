"""Names and forms in which programs and people write the parts of a camera.

The names are in lower-case letters and digits. The values may be numbers, matrices, and entries of one.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.files.tree_fields import is_number, plain

# The keys of a camera as they are written here, by ROS and by OpenCV, and how else people call them.
_OTHERS = {
    "camera_name": "",
    "image_width": "width w imgwidth imgw framewidth resolutionx imgsizex resx widthpx",
    "image_height": "height h imgheight imgh frameheight resolutiony imgsizey resy heightpx",
    "image_size": (  # width and height
        "imgsize resolution size dim dims imageresolution imagedimensions dimensions framesize "
        "calibdimension cameraresolution imsize calibrationresolution capturedimagesize"
    ),
    "image_shape": "imgshape shape grayshape frameshape",  # NumPy's: height and width
    # Its text names the model; an unknown word is refused in the first, ignored in the second.
    "distortion_model": "distmodel distortiontype disttype distortion",
    "camera_model": (
        "calibrationmodel opencvmodel model cameratype projection projectionmodel lensmodel lenstype "
        "modeltype type calibrationtype projectiontype lens"
    ),
    "fisheye_model": "fisheye isfisheye usefisheye useopencvfisheye",  # true or false
    "xi": "",
    # Of the images as they were taken, where a file has the matrix of undistorted ones as well.
    "original_matrix": (
        "cammatrixoriginal cameramatrixoriginal originalcameramatrix originalcammatrix koriginal korig "
        "originalk mtxoriginal kraw rawk cameramatrixraw kdistorted"
    ),
    "camera_matrix": (  # in OpenCV's stereo sample the left camera has M1 and D1
        "k mtx m intrinsicmatrix intrinsicsmatrix cameraintrinsics intrinsics cameraintrinsic intrinsic "
        "camintrinsics cammatrix cammtx cameramtx kmatrix kmat matrix intrinsicmat intrinsicparameters "
        "calibrationmatrix intrinsicparams camerak cameramat kk m1 cm intrinsicmtx camk camintr camera"
    ),
    "distortion_coefficients": (
        "distcoeffs distcoeff distcoefs distcoef distortioncoeffs distortioncoeff distortioncoefs "
        "distortioncoef distortioncoefficient distcoefficients distortion distortions dist d kc coefs "
        "coeffs coef coefficients distortionparameters distortionparams distparams distortionvector "
        "distortionmatrix distvec lensdistortion cameradistortion distmtx distmatrix camdist disto distcof "
        "distcoffs distortionvalues opencvdistortion d1 cameradistcoeffs "
        "camdistcoeffs cameradistcoeff camdistcoeff cameradistortioncoefficients "
        "lensdistortioncoefficients distortioncoeficients distcoefficient"
    ),
    "fx": "flx focalx fu focallengthx fxpx focallengthxpx",
    "fy": "fly focaly fv focallengthy fypx focallengthypx",
    "cx": "ppx u0 pu principalpointx cxpx focalcenterxpx",
    "cy": "ppy v0 pv principalpointy cypx focalcenterypx",
    "skew": "s",
    "focal_length": "focallengths focal focalpx focallengthpx f",  # of both axes, or one for both
    "principal_point": "principlepoint opticalcenter princpt imagecenter c",
    "aspect_ratio": "pixelaspectratio pixelratio pixelaspect",
    "radial_distortion": "radial radialcoefficients radialdistortioncoefficients radialcoeffs",
    "tangential_distortion": (
        "tangential tangentialcoefficients tangentialdistortioncoefficients tangentialcoeffs"
    ),
    "R": "rstereo stereor rotation rotationmatrix rot",  # of the second camera
    "T": "tstereo stereot translation translationvector trans trns",
    "rectification_matrix": "rectification r",
    "projection_matrix": "projection p",
}
# Of all numbers in one list: fx, fy, cx, cy, and the coefficients.
_PARAMETERS = "calibration calib cameraparams cameraparameters"
ENTRIES = ("fx", "fy", "cx", "cy")

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
_SUSPECT = re.compile(r"dist(?!an|rib)|^kc|coef|radial|tangent")
_SUSPECT_NUMBER = re.compile(r"[kps]\d|xi|kc\d")  # of the plain name, whole
_SUSPECT_WORD = re.compile(  # of the name as it is
    r"(?:^|[\W_])[kp]{1,2}_?[1-6][a-z]?(?:[\W_]|$)|^(?:alpha|beta)$", re.IGNORECASE
)
_SUSPECT_SCALAR = re.compile(r"(?:radial|tangential|distortion|coef)\w*\d$|^kappa\d?$|^lambda$")  # plain
_INVERSE = re.compile(r"^undistortion(?:coef\w*|param\w*)?$|^invdist|^inversedist")  # plain
HARMLESS = re.compile(
    r"std|err|undist|newcam|uncert|sigma|limit|rms|perview|roi|optimal|thresh|flag|aspect|fix|rect|^est|valid"
    r"|prior"
)
_NO_LIST = re.compile(
    r"roi|quat|rot|^q\d?$|rect|crop|box|board|pattern|size|color|time|pose|trans|orient|^[rtp]\d?$"
)
_LENGTHS = (4, 5, 8, 12, 14)
_MOST_OF_ONE = 6  # coefficients of one kind
_LONG = 40  # characters of a text that may hold packed numbers


NAMES = {key: (plain(key), *others.split()) for key, others in _OTHERS.items()}
PARAMETERS = (*NAMES["camera_matrix"], *_PARAMETERS.split())


def means(word: str) -> str | None:
    """ROS's name of the distortion model that a word names, ``unknown``, or None if it names none."""
    return next((model for pattern, model in _WORDS if re.search(pattern, plain(word))), None)


_MOST = 100.0  # of a coefficient


def is_numbers(value: Any) -> bool:
    """Whether this is a number, a list of numbers at any depth, a matrix, or x and y."""
    if isinstance(value, dict):
        return "data" in value or (value.keys() == {"x", "y"} and all(map(is_numbers, value.values())))
    if isinstance(value, (list, tuple)):
        return bool(value) and all(map(is_numbers, value))
    if isinstance(value, str):
        return is_number(value) is not None
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def is_matrix(value: Any) -> bool:
    """Whether these are nine numbers in any form."""
    return not isinstance(value, (int, float, str)) and is_numbers(value) and len(flat(value)) == 9


def is_four(value: Any) -> bool:
    """Whether this is a list of fx, fy, cx, cy."""
    return isinstance(value, list) and len(value) == 4 and all(is_number(str(entry)) for entry in value)


def has_entries(value: Any) -> bool:
    """Whether a mapping has fx, fy, cx and cy under one of their names, or the pairs of them."""
    if not isinstance(value, dict):
        return False
    names = {plain(str(key)) for key, entry in value.items() if not isinstance(entry, (dict, list))}
    pairs = {plain(str(key)) for key, entry in value.items() if is_numbers(entry)}
    one = not names.isdisjoint(NAMES["focal_length"])  # for both axes
    return all(not names.isdisjoint(NAMES[key]) for key in ENTRIES[2 if one else 0 :]) or not (
        pairs.isdisjoint(NAMES["focal_length"]) or pairs.isdisjoint(NAMES["principal_point"])
    )


def plain_lists(tree: Any, depth: int = 5) -> Any:
    """The tree with lists for the mappings 0, 1, ... of JavaScript's arrays, and for numbers in a text."""
    if isinstance(tree, str) and len(words := tree.replace(",", " ").strip(" []").split()) > 3:
        return [float(word) for word in words] if all(map(is_number, words)) else tree
    if not isinstance(tree, dict) or depth == 0:
        return tree
    if tree and all(key == str(k) and is_numbers(value) for k, (key, value) in enumerate(tree.items())):
        return list(tree.values())
    return {key: plain_lists(value, depth - 1) for key, value in tree.items()}


def parameters_apart(tree: dict[str, Any]) -> dict[str, Any]:
    """The tree with fx, fy, cx, cy and the coefficients of a list of all as keys of their own."""
    for key, value in tree.items():
        if not (isinstance(value, list) and len(value) in (4, 8, 9, 12) and plain(str(key)) in PARAMETERS):
            continue
        four, k = value[:4], value[4:]
        if all(type(n) in (int, float) for n in value) and min(four) > 1 and all(abs(n) < _MOST for n in k):
            named = dict(zip(("fx", "fy", "cx", "cy"), four, strict=True))
            if not named.keys() & tree.keys():
                own = {**named, **({"distortion_coefficients": k} if k else {})}
                return {**{name: entry for name, entry in tree.items() if name != key}, **own}
    return tree


def matrix_of(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> Array:
    """The camera matrix of its entries."""
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def flat(value: Any) -> list[float]:
    """The numbers in nested lists, or in a matrix."""
    if isinstance(value, dict):
        return flat(value["data"] if "data" in value else [value.get("x", []), value.get("y", [])])
    if isinstance(value, (list, tuple)):
        return [number for entry in value for number in flat(entry)]
    return [float(value)] if is_numbers(value) else [float("nan")]


def have_gap(names: Collection[str]) -> bool:
    """Whether one of k1, k2, ... is missing before another of these or p1, or one of p1 and p2."""
    last = max([2 * ("p1" in names), *(int(name[1:]) for name in names if name[0] == "k")])
    return not {f"k{n}" for n in range(1, last + 1)} <= set(names) or ("p1" in names) != ("p2" in names)


def may_be_distortion(key: str, value: Any, guess: bool, every: bool = False) -> bool:
    """Whether a value that was not read may be the distortion, by its name and its numbers.

    If `guess`, a list of as many numbers as there are coefficients has any name; if `every`, each number has.
    """
    name = plain(key)
    inverse = guess and _INVERSE.search(name) is not None
    if HARMLESS.search(name) and not inverse:
        return False
    if isinstance(value, str) and not is_numbers(value):
        numbers, value = [1.0] * (len(value) >= _LONG and " " not in value), []
    elif isinstance(value, dict) and not is_numbers(value):
        numbers = [n for entry in value.values() if is_numbers(entry) for n in flat(entry)]
    elif is_numbers(value):
        numbers = flat(value)
    else:
        return False
    if isinstance(value, (list, dict)):
        listed = guess and len(numbers) in _LENGTHS and not _NO_LIST.search(name)
        suspect = _SUSPECT.search(name) is not None or (listed and any(n % 1 != 0 for n in numbers))
        suspect = suspect or inverse or (name in ("k", "p") and len(numbers) <= _MOST_OF_ONE)
    else:
        word = every or _SUSPECT_WORD.search(key) or _SUSPECT_SCALAR.search(name)
        suspect = _SUSPECT_NUMBER.fullmatch(name) is not None or (bool(word) and numbers[0] % 1 != 0)
    return suspect and any(numbers)
