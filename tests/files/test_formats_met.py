"""Cameras in the forms in which programs, data sets and people keep them, each written here anew."""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from test_other_programs import POINT, check, rotated

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, NeurocalError
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.reading import read_cameras, read_points_or_cameras

K = [[800.5, 0.0, 321.3], [0.0, 801.25, 238.7], [0.0, 0.0, 1.0]]
FLAT, COLUMNS = np.ravel(K).tolist(), [entry for column in zip(*K, strict=True) for entry in column]
E, ROUND = [800.5, 0.0, 801.25, 321.3, 238.7], [800.5, 0.0, 800.5, 321.3, 238.7]
D5 = [-0.31, 0.12, 0.0011, -0.0007, 0.02]
D4, D8 = D5[:4], [*D5, 0.03, -0.01, 0.002]
FOUR = [0.05, -0.012, 0.004, -0.001]
FISH = ["fisheye", *FOUR]
S = (640, 480)
EYE = np.eye(4).tolist()
TURN, SHIFT = [0.02, -0.1, 0.03], [-60.0, 0.1, 0.2]
R = np.array([rotated(TURN, axis) for axis in np.eye(3)]).T.tolist()
NAMED = dict(zip(("k1", "k2", "p1", "p2", "k3"), D5, strict=True))
FXY = {"fx": 800.5, "fy": 801.25, "cx": 321.3, "cy": 238.7}
WH = {"width": 640, "height": 480}


def lines(head: str, prefix: str, **values: object) -> str:
    return head + "".join(f"{prefix}{key}: {value}\n" for key, value in values.items())


def visp(*models: str) -> str:
    """A file of ViSP with models of one camera."""
    focal = "<px>800.5</px><py>801.25</py><u0>321.3</u0><v0>238.7</v0>"
    parts = "".join(
        f"<model><type>{model.partition(' ')[0]}</type>{focal}{model.partition(' ')[2]}</model>"
        for model in models
    )
    size = "<image_width>640</image_width><image_height>480</image_height>"
    return f"""<?xml version="1.0"?>
<root><!--vpCameraParameters--><camera><name>Camera</name>{size}{parts}
<additional_information><date>2020/05/13</date></additional_information></camera></root>"""


def metashape(kind: str, more: str) -> str:
    elements = f"<f>801.25</f><cx>1.8</cx><cy>-0.8</cy><b1>-0.75</b1>{more}"
    return (
        '<?xml version="1.0"?>\n<document version="1.5.0"><chunk><sensors><sensor id="0" label="A" type="'
        f'{kind}"><resolution width="640" height="480"/><bands><band label="R"/><band label="G"/></bands>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="640" height="480"/>{elements}'
        "</calibration></sensor></sensors><cameras/></chunk></document>"
    )


def openmvg(name: str, **data: object) -> Any:
    inner = {**WH, "focal_length": 800.5, "principal_point": [321.3, 238.7], **data}
    value = {"polymorphic_id": 2147483649, "polymorphic_name": name, "ptr_wrapper": {"id": 1, "data": inner}}
    return {"sfm_data_version": "0.3", "views": [], "intrinsics": [{"key": 0, "value": value}]}


def meshroom(version: list[str], **more: object) -> Any:
    one = {"intrinsicId": "7", "width": "640", "height": "480", "sensorWidth": "36", "locked": "false"}
    return {"version": version, "views": [], "intrinsics": [{**one, **more}]}


def frame(k: int, **more: object) -> Any:
    return {"file_path": f"{k}.png", "transform_matrix": EYE, **more}


FX_LINES = {"fx": 800.5, "fy": 801.25, "cx": 321.3, "cy": 238.7}
BROWN = dict(zip(("k1", "k2", "p1", "p2"), D4, strict=True))
KB = dict(zip(("k1", "k2", "k3", "k4"), FOUR, strict=True))
MATLAB = {
    "ImageSize": [480, 640],
    "FocalLength": [800.5, 801.25],
    "PrincipalPoint": [322.3, 239.7],
    "Skew": 0,
    "RadialDistortion": [-0.31, 0.12, 0.02],
    "TangentialDistortion": [0.0011, -0.0007],
}
EEPROM = dict(
    zip(
        ("cx", "cy", "fx", "fy", "k1", "k2", "k3", "k4", "k5", "k6"),
        [0.5, 0.5025, 0.478, 0.6372, *D8[:2], *D8[4:]],
        strict=True,
    )
)
KINECT = {
    "CalibrationInformation": {
        "Cameras": [
            {
                "Purpose": "CALIBRATION_CameraPurposePhotoVideo",
                "SensorWidth": 4096,
                "SensorHeight": 3072,
                "Intrinsics": {
                    "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
                    "ModelParameters": [*EEPROM.values(), 0, 0, D5[3], D5[2], 1.7],
                },
            }
        ]
    }
}
LIBCALIB = {
    "f": 800.5,
    "ar": 801.25 / 800.5,
    "cx": 321.3,
    "cy": 238.7,
    **NAMED,
    "k4": 0.03,
    "k5": -0.01,
    "k6": 0.002,
}


def argoverse(R: Array, t: Array) -> Any:
    """A camera with the pose R X + t of the vehicle."""
    x, y, z, w = Rotation.from_matrix(R.T).as_quat()
    body = {"rotation": {"coefficients": [w, x, y, z]}, "translation": (-R.T @ t).tolist()}
    names = ("focal_length_x_px_", "focal_length_y_px_", "focal_center_x_px_", "focal_center_y_px_")
    lens = {"skew_": 0.0, "distortion_coefficients_": [*D5[:2], D5[4]]}
    return {**dict(zip(names, FXY.values(), strict=True)), **lens, "vehicle_SE3_camera_": body}


def nuscenes(name: str, R: Array, t: Array) -> Any:
    """A sensor with the pose R X + t of the vehicle."""
    x, y, z, w = Rotation.from_matrix(R.T).as_quat()
    back = {"translation": (-R.T @ t).tolist(), "rotation": [w, x, y, z]}
    return {"token": "a", "sensor_token": name, **back, "camera_intrinsic": K}


EMPTY: dict[str, Any] = {"camera_intrinsic": []}
PIX4D = (
    "fileName imageWidth imageHeight\ncamera matrix K [3x3]\nradial distortion [3x1]\ntangential distortion "
    "[2x1]\ncamera position t [3x1]\ncamera rotation R [3x3]\ncamera model m = K [R|-Rt] X\n\n"
) + "".join(
    f"a photo {k}.jpg 640 480\n800.5 0 321.3\n0 801.25 238.7\n0 0 1\n{D5[0]} {D5[1]} {D5[4]}\n"
    f"{D5[2]} {D5[3]}\n1 2 {k}\n1 0 0\n0 -1 0\n0 0 -1\n"
    for k in (3, 4)
)
DEWARP = f"2020-09-02;800.5,801.25,1.8,-0.8,{','.join(map(str, D5))}"
# Of each kind: the text or the tree, the entries of its camera, the coefficients, and the size.
MET: dict[str, tuple[Any, list[float], list[Any], tuple[int, int] | None]] = {
    "ZOD": (
        {
            "FC": {
                "extrinsics": EYE,
                "intrinsics": [[*row, 0] for row in K],
                "distortion": FOUR,
                "undistortion": [0.1, 0.2, 0.3, 0.4],
                "image_dimensions": [640, 480],
            }
        },
        E,
        FISH,
        S,
    ),
    "OpenCV in ROS parameters": (
        {
            "/**": {
                "ros__parameters": {
                    "camera_name": "a",
                    "image_width": 640,
                    "image_height": 480,
                    "camera_matrix": {"rows": 3, "cols": 3, "data": FLAT},
                    "distortion_model": "plumb_bob",
                    "distortion_coefficients": {"rows": 1, "cols": 5, "data": D5},
                }
            }
        },
        E,
        D5,
        S,
    ),
    "Pix4D": (PIX4D, E, D5, S),
    "OpenICC": (
        {
            "intrinsic_type": "FISHEYE",
            "image_width": 640,
            "image_height": 480,
            "final_reproj_error": 0.21,
            "intrinsics": {
                "focal_length": 800.5,
                "aspect_ratio": 801.25 / 800.5,
                "skew": 0.0,
                "principal_pt_x": 321.3,
                "principal_pt_y": 238.7,
                **{f"radial_distortion_{n}": one for n, one in enumerate(FOUR, 1)},
            },
        },
        E,
        FISH,
        S,
    ),
    "Blender's NeRF": (
        {
            "camera_angle_x": 2 * float(np.arctan(320 / 800.5)),
            **dict(zip("wh", S, strict=True)),
            "near": 0.5,
            "far": 6.5,
            "frames": [frame(k, rotation=0.0125663706, timestamp=1.5) for k in (1, 2)],
        },
        [800.5, 0, 800.5, 319.5, 239.5],
        [],
        S,
    ),
    "two coefficients beside other numbers": (
        {**FXY, "k1": -0.31, "k2": 0.12, "fps": 29.97, "square_size": 0.025, "focal_length_mm": 3.04, **WH},
        E,
        D4[:2],
        S,
    ),
    "nerfstudio beside other numbers": (
        {
            "fl_x": 800.5,
            "fl_y": 801.25,
            "cx": 321.8,
            "cy": 239.2,
            "w": 640,
            "h": 480,
            **BROWN,
            "near": 0.05,
            "scene_scale": 1.5,
            "applied_scale": 0.93,
            "frames": [frame(1, sharpness=87.5)],
        },
        E,
        D4,
        S,
    ),
    "ORB-SLAM3 beside other numbers": (
        lines('%YAML:1.0\nCamera.type: "PinHole"\n', "Camera1.", **FX_LINES, **BROWN, overlappingEnd=511)
        + "Camera.width: 640\nCamera.height: 480\nCamera.fps: 29.97\nCamera.bf: 47.91\nStereo.ThDepth: 40.5\n"
        "ORBextractor.scaleFactor: 1.2\nIMU.NoiseGyro: 1.7e-4\nViewer.KeyFrameSize: 0.05\n",
        E,
        D4,
        S,
    ),
    "kapture": (
        "# kapture format: 1.1\n# sensor_id, name, sensor_type, [sensor_params]+\n"
        f"a, , camera, OPENCV, 640, 480, 800.5, 801.25, 321.8, 239.2, {', '.join(map(str, D4))}\n"
        "g, , gnss, E\n",
        E,
        D4,
        S,
    ),
    "Polycam": (
        {"frames": [frame(k, fl_x=800.5, fl_y=801.25, cx=321.8, cy=239.2, w=640, h=480) for k in (1, 2)]},
        E,
        [],
        S,
    ),
    "instant-ngp's angle": (
        {"camera_angle_x": 2 * np.arctan(320 / 800.5), "w": 640, "h": 480, "frames": [frame(1)]},
        [800.5, 0, 800.5, 319.5, 239.5],
        [],
        S,
    ),
    "OpenVSLAM's fisheye": (
        lines(
            "%YAML:1.0\n", "Camera.", setup="monocular", model="fisheye", **FX_LINES, **KB, cols=640, rows=480
        ),
        E,
        FISH,
        S,
    ),
    "stella_vslam": (
        lines(
            "Camera:\n", "  ", setup="monocular", model="perspective", **FX_LINES, **NAMED, cols=640, rows=480
        ),
        E,
        D5,
        S,
    ),
    "ORB-SLAM3's fisheye": (
        lines('%YAML:1.0\nCamera.type: "KannalaBrandt8"\n', "Camera1.", **FX_LINES, **KB)
        + "Camera.width: 640\nCamera.height: 480\n",
        E,
        FISH,
        S,
    ),
    "vikit": (
        lines(
            "cam_model: Pinhole\n",
            "cam_",
            width=640,
            height=480,
            **FX_LINES,
            d0=-0.31,
            d1=0.12,
            d2=0.0011,
            d3=-0.0007,
        ),
        E,
        D4,
        S,
    ),
    "vikit's fisheye": (
        lines("cam_model: EquidistantCamera\n", "cam_", width=640, height=480, **FX_LINES)
        + lines("", "", **KB),
        E,
        FISH,
        S,
    ),
    "DSO": (f"RadTan 800.5 801.25 321.3 238.7 {' '.join(map(str, D4))}\n640 480\ncrop\n640 480\n", E, D4, S),
    "DSO, relative": (
        "Pinhole 1.25078125 1.669270833333333 0.5028125 0.4983333333333333 0\n640 480\ncrop\n640 480\n",
        E,
        [],
        S,
    ),
    "DSO's fisheye": (
        f"KannalaBrandt 800.5 801.25 321.3 238.7 {' '.join(map(str, FOUR))}\n640 480\nfull\n1 1\n",
        E,
        FISH,
        S,
    ),
    "MATLAB's cameraIntrinsics": (MATLAB, E, D5, S),
    "MATLAB's cameraParameters": (
        {**MATLAB, "K": [[800.5, 0, 322.3], [0, 801.25, 239.7], [0, 0, 1]]},
        E,
        D5,
        S,
    ),
    "a project of Metashape": (
        metashape("frame", "<k1>-0.31</k1><k2>0.12</k2><k3>0.02</k3><p1>-0.0007</p1><p2>0.0011</p2>"),
        E,
        D5,
        S,
    ),
    "ViSP": (
        visp(
            "perspectiveProjWithoutDistortion",
            "perspectiveProjWithDistortion <kud>-0.31</kud><kdu>0.33</kdu>",
        ),
        E,
        [-0.31, 0, 0, 0, 0],
        S,
    ),
    "ViSP without distortion": (visp("perspectiveProjWithoutDistortion"), E, [0, 0, 0, 0, 0], S),
    "ViSP's fisheye": (
        visp(
            "ProjWithKannalaBrandtDistortion " + "".join(f"<k{k}>{c}</k{k}>" for k, c in enumerate(FOUR, 1))
        ),
        E,
        FISH,
        S,
    ),
    "Metashape's fisheye": (
        metashape("fisheye", "<k1>0.05</k1><k2>-0.012</k2><k3>0.004</k3><k4>-0.001</k4>"),
        E,
        FISH,
        S,
    ),
    "OpenMVG": (
        openmvg("pinhole_radial_k3", disto_k3=[-0.31, 0.12, 0.02]),
        ROUND,
        [-0.31, 0.12, 0, 0, 0.02],
        S,
    ),
    "OpenMVG, Brown": (
        openmvg("pinhole_brown_t2", disto_t2=[-0.31, 0.12, 0.02, 0.0011, -0.0007]),
        ROUND,
        D5,
        S,
    ),
    "OpenMVG's fisheye": (openmvg("fisheye", fisheye=FOUR), ROUND, FISH, S),
    "Meshroom": (
        meshroom(
            ["1", "2", "6"],
            type="pinhole",
            focalLength="45.028125",
            pixelRatio="1.0009369144284822",
            principalPoint=["1.3", "-1.3"],
            distortionType="radialk3",
            distortionParams=["-0.31", "0.12", "0.02"],
        ),
        E,
        [-0.31, 0.12, 0, 0, 0.02],
        S,
    ),
    "old Meshroom": (
        meshroom(
            ["1", "0", "0"],
            type="fisheye4",
            pxFocalLength="800.5",
            principalPoint=["321.3", "238.7"],
            distortionParams=[str(k) for k in FOUR],
        ),
        ROUND,
        FISH,
        S,
    ),
    "OpenDroneMap": (
        {
            "v2 dji 640 480 brown": {
                "projection_type": "brown",
                **WH,
                "focal_x": 800.5 / 640,
                "focal_y": 801.25 / 640,
                "c_x": 1.8 / 640,
                "c_y": -0.8 / 640,
                **NAMED,
            }
        },
        E,
        D5,
        S,
    ),
    "OpenSfM": (
        {"a": {"projection_type": "perspective", **WH, "focal": 800.5 / 640, "k1": -0.31, "k2": 0.12}},
        [800.5, 0, 800.5, 319.5, 239.5],
        [-0.31, 0.12],
        S,
    ),
    "OpenSfM's fisheye": (
        {
            "projection_type": "fisheye_opencv",
            **WH,
            "focal_x": 800.5 / 640,
            "focal_y": 801.25 / 640,
            "c_x": 1.8 / 640,
            "c_y": -0.8 / 640,
            **KB,
        },
        E,
        FISH,
        S,
    ),
    "Apple's columns": ({"w": 640, "h": 480, "K": COLUMNS, "fps": 60}, E, [], S),
    "ARKit's rows": ({"intrinsics": FLAT, "projectionMatrix": [1.5] * 16, "time": 1}, E, [], None),
    "ARCore": (
        {"focalLength": [800.5, 801.25], "principalPoint": [321.3, 238.7], "imageDimensions": [640, 480]},
        E,
        [],
        S,
    ),
    "a focal length alone": (
        {
            "focal_length": 800.5,
            "principal_point": [321.3, 238.7],
            "image_size": [640, 480],
            "dist_coeffs": D5,
        },
        ROUND,
        D5,
        S,
    ),
    "four numbers": (
        {
            "camera_matrix": list(FXY.values()),
            "distortion_coeffs": D4,
            "distortion_model": "radtan",
            "resolution": [640, 480],
        },
        E,
        D4,
        S,
    ),
    "MVSNet": (
        "extrinsic\n1 0 0 0.5\n0 1 0 0.2\n0 0 1 3\n0 0 0 1\n\nintrinsic\n800.5 0 321.3\n0 801.25 238.7\n"
        "0 0 1\n\n425 2.5\n",
        E,
        [],
        None,
    ),
    "KWIVER": (
        "800.5 0 321.3\n0 801.25 238.7\n0 0 1\n\n1 0 0\n0 1 0\n0 0 1\n\n0.1 0.2 30\n\n"
        f"{' '.join(map(str, D5))}\n",
        E,
        D5,
        None,
    ),
    "NDDS": (
        {
            "camera_settings": [
                {"name": "a", "intrinsic_settings": {**FXY, "s": 0}, "captured_image_size": WH}
            ]
        },
        E,
        [],
        S,
    ),
    "BOP": (
        {str(k): {"cam_K": FLAT, "cam_t_w2c": [0, 0, 500 + k], "depth_scale": 1} for k in range(3)},
        E,
        [],
        None,
    ),
    "Open3D's trajectory": (
        {
            "parameters": [
                {"extrinsic": np.ravel(EYE).tolist(), "intrinsic": {**WH, "intrinsic_matrix": COLUMNS}}
                for _ in range(2)
            ]
        },
        E,
        [],
        S,
    ),
    "Spectacular AI": (
        {
            "cameras": [
                {
                    "focalLengthX": 800.5,
                    "focalLengthY": 801.25,
                    "principalPointX": 321.3,
                    "principalPointY": 238.7,
                    "model": "pinhole",
                    "imageWidth": 640,
                    "imageHeight": 480,
                }
            ]
        },
        E,
        [],
        S,
    ),
    "calib.io": (
        {
            "Calibration": {
                "cameras": [
                    {
                        "model": {
                            "polymorphic_name": "libCalib::CameraModelOpenCV",
                            "ptr_wrapper": {
                                "data": {
                                    "parameters": {key: {"val": v} for key, v in LIBCALIB.items()},
                                    "CameraModelCRT": {"CameraModelBase": {"imageSize": WH}},
                                }
                            },
                        }
                    }
                ]
            }
        },
        E,
        D8,
        S,
    ),
    "printed matrices": (
        "Camera matrix:\n[[800.5    0.   321.3 ]\n [  0.   801.25 238.7 ]\n [  0.     0.     1.  ]]"
        "\n"
        "Distortion coefficients:\n[[-0.31  0.12  0.0011 -0.0007  0.02]]\n",
        E,
        D5,
        None,
    ),
    "coefficients beside the entries": ({"intrinsics": {**FXY, **NAMED, **WH}}, E, D5, S),
    "sections": (lines("[Intrinsics]\n", "", **FXY, **NAMED, **WH).replace(": ", "="), E, D5, S),
    "Unity": (
        {"focalLength": {"x": 800.5, "y": 801.25}, "principalPoint": {"x": 321.3, "y": 238.7}}
        | {"resolution": {"x": 640, "y": 480}},
        E,
        [],
        S,
    ),
    "rows in data": (
        {"camera_matrix": {"rows": 3, "cols": 3, "data": K}, "dist": {"rows": 1, "cols": 5, "data": [D5]}},
        E,
        D5,
        None,
    ),
    "Gear 360 Stitcher": (
        {"resolution": [640, 480], "params_ds": {**FXY, "alpha": 0.56, "Xi": 0.1}},
        E,
        ["double_sphere", 0.1, 0.56],
        S,
    ),
    "DROID-SLAM": (f"800.5 801.25 321.3 238.7 {' '.join(map(str, D5))}\n", E, D5, None),
    "Azure Kinect": (
        KINECT,
        [0.478 * 1920, 0, 0.6372 * 1440, 959.5, 0.5025 * 1440 - 180.5],
        D8,
        (1920, 1080),
    ),
}

DUMP = "[800.5, 0, 321.3;\n 0, 801.25, 238.7;\n 0, 0, 1]\n"
STREAM = (
    ' Intrinsic of "{}" / 640x480 / {{YUYV/RGB8}}\n  Width:      \t640\n  Height:     \t480\n'
    "  PPX:        \t321.3\n  PPY:        \t238.7\n  Fx:         \t800.5\n  Fy:         \t801.25\n"
    "  Distortion: \t{}\n  Coeffs:     \t{}\n"
    "  FOV (deg):  \t44 x 33\n\n"
)
RADIAL, TANGENTIAL = [D5[0], D5[1], D5[4]], D5[2:4]
HALVED = (np.array(K) * [[0.5], [0.5], [1]]).tolist()
ECHO = lines(
    "height: 480\nwidth: 640\ndistortion_model: plumb_bob\n", "", D=D5, K=FLAT, R=np.ravel(np.eye(3)).tolist()
)
ECHO += lines("", "", P=[0.0] * 12, binning_x=0, binning_y=0)
MET |= {
    "mmpose": (
        {"R": R, "T": [[0], [0], [1]], "f": [[800.5], [801.25]], "c": [[321.3], [238.7]], "name": "a"}
        | {"k": [[k] for k in RADIAL], "p": [[p] for p in TANGENTIAL]},
        E,
        D5,
        None,
    ),
    "VoxelPose": (
        {"0": {"K": K, "R": R, "T": [[0], [0], [1]], **FXY, "k": [[k] for k in RADIAL], "p": TANGENTIAL}},
        E,
        D5,
        None,
    ),
    "Nerfies": (
        {"orientation": R, "position": [0, 0, 1], "focal_length": 800.5, "principal_point": [321.8, 239.2]}
        | {"skew": 0.0, "pixel_aspect_ratio": 801.25 / 800.5, "radial_distortion": RADIAL}
        | {"tangential_distortion": TANGENTIAL, "image_size": [640, 480]},
        E,
        D5,
        S,
    ),
    "A2D2": (
        {"CamMatrix": HALVED, "CamMatrixOriginal": K, "Distortion": [D5], "Lens": "Telecam"},
        E,
        D5,
        None,
    ),
    "Waymo": ({"name": "FRONT", "intrinsic": [800.5, 801.25, 321.3, 238.7, *D5], **WH}, E, D5, S),
    "MASt3R-SLAM": (
        f"width: 640\nheight: 480\n# fx, fy, cx, cy, k1\ncalibration: {[*FXY.values(), *D5]}\n",
        E,
        D5,
        S,
    ),
    "names with one beginning": ({"color_intrinsics": FXY, "color_distortion": NAMED}, E, D5, None),
    "Orbbec": (
        lines("[ColorIntrinsic]\n", "", **FXY, **WH).replace(": ", "=")
        + lines("[ColorDistortion]\n", "", **NAMED).replace(": ", "="),
        E,
        D5,
        S,
    ),
    "arrays of JavaScript": (
        {key: {str(k): v for k, v in enumerate(value)} for key, value in (("K", FLAT), ("D", D5))},
        E,
        D5,
        None,
    ),
    "OpenCV's text of matrices": (f"CameraMatrix:\n{DUMP}DistCoeffs:\n{D5}\n", E, D5, None),
    "a script of Python": (
        f"import numpy as np\nmtx = np.array({K})\ndist = np.array([{D5}])\n",
        E,
        D5,
        None,
    ),
    "text of NumPy's arrays": (f"mtx = {np.array(K)!r}\ndist = {np.array([D5])!r}\n", E, D5, None),
    "a script of MATLAB": (f"% of tuesday\nK = {DUMP.strip()};\ndist = {D5};\n", E, D5, None),
    "a row of a table": (
        "fx_px,fy_px,cx_px,cy_px,k1,k2,p1,p2,k3,height_px,width_px\n"
        f"800.5,801.25,321.3,238.7,{','.join(map(str, D5))},480,640\n",
        E,
        D5,
        S,
    ),
    "names without sections": (lines("", "", **FXY, **NAMED).replace(": ", "="), E, D5, None),
    "rs-enumerate-devices": (STREAM.format("Color", "Brown Conrady", "  \t".join(map(str, D5))), E, D5, S),
    "text of a RealSense": (
        "[ 640x480  p[321.3 238.7]  f[800.5 801.25]  Inverse Brown Conrady [0 0 0 0 0] ]\n",
        E,
        [],
        S,
    ),
    "a struct of MATLAB with K": (
        {"K": [[800.5, 0, 322.3], [0, 801.25, 239.7], [0, 0, 1]], "RadialDistortion": RADIAL}
        | {"TangentialDistortion": TANGENTIAL, "ImageSize": [480, 640]},
        E,
        D5,
        S,
    ),
    "pycolmap": (
        {"model": "OPENCV", **WH, "params": [800.5, 801.25, 321.8, 239.2, *D4]},
        E,
        D4,
        S,
    ),
    "one focal length": (
        {"f": 800.5, "cx": 321.3, "cy": 238.7, "k1": -0.31, "k2": 0.12},
        ROUND,
        [-0.31, 0.12],
        None,
    ),
    "a matrix of raw images": ({"K": HALVED, "K_raw": K, "D": D5}, E, D5, None),
    "numbers in a text": ({"K": " ".join(map(str, FLAT)), "D": str(D5)}, E, D5, None),
    "a dictionary that Python prints": (f"{ {'mtx': np.array(K), 'dist': np.array([D5])} }\n", E, D5, None),
    "a double sphere": (
        {"model": "ds", **FXY, "xi": -0.2, "alpha": 0.6},
        E,
        ["double_sphere", -0.2, 0.6],
        None,
    ),
    "rows of names": (lines("", "", **FXY, **NAMED).replace(":", ""), E, D5, None),
    "rows of a matrix": (f"K {' '.join(map(str, FLAT))}\nD {' '.join(map(str, D5))}\n", E, D5, None),
    "OpenCV's matrices named Camera and Distortion": ({"Camera": K, "Distortion": D5}, E, D5, None),
    "a matrix and its coefficients": (
        "".join(f"{' '.join(map(str, row))}\n" for row in [*K, D5]),
        E,
        D5,
        None,
    ),
    "definitions of C": (
        lines("", "#define ", **{k.upper(): v for k, v in (FXY | NAMED).items()}).replace(":", ""),
        E,
        D5,
        None,
    ),
    "matrices of C++": (
        f"cv::Mat K = (cv::Mat_<double>(3, 3) << {str(FLAT)[1:-1]});\n"
        f"cv::Mat D = (cv::Mat_<double>(1, 5) << {str(D5)[1:-1]});\n",
        E,
        D5,
        None,
    ),
    "a RealSense's fisheye": (
        STREAM.format("Fisheye 1", "Kannala Brandt4", f"{str(FOUR)[1:-1].replace(',', '')} 0"),
        E,
        FISH,
        S,
    ),
    "messages of ROS": ("".join(f"header:\n  seq: {k}\n{ECHO}---\n" for k in range(2)), E, D5, S),
    "R3LIVE": (
        lines(
            "r3live_vio:\n",
            "  ",
            image_width=640,
            image_height=480,
            camera_intrinsic=FLAT,
            camera_dist_coeffs=D5,
        ),
        E,
        D5,
        S,
    ),
}


def written(content: Any, folder: Path) -> Path:
    place = folder / "camera"
    place.write_text(content if isinstance(content, str) else json.dumps(content))
    return place


@pytest.mark.parametrize("kind", MET)
def test_a_camera_as_it_is_kept_is_read(kind: str, tmp_path: Path) -> None:
    content, entries, lens, size = MET[kind]
    size_of = (1920, 1080) if kind == "Azure Kinect" else None
    found = read_points_or_cameras([written(content, tmp_path)], size=size_of)
    assert isinstance(found, CameraSet)
    check(found.cameras[0], entries, lens)
    assert found.cameras[0].image_size == size


def oak(socket: int, to: int, t: list[float]) -> list[Any]:
    link = {"rotationMatrix": R, "toCameraSocket": to, "translation": dict(zip("xyz", t, strict=True))}
    one = {
        "cameraType": 0,
        "distortionCoeff": [*D8, *[0.0] * 6],
        "intrinsicMatrix": K,
        **WH,
        "extrinsics": link,
    }
    return [socket, one]


def mc_calib(*poses: list[list[float]], group: int = 0) -> dict[str, Any]:
    cameras = {
        f"camera_{k}": {
            "camera_matrix": {"rows": 3, "cols": 3, "dt": "d", "data": FLAT},
            "distortion_vector": {"rows": 1, "cols": 5, "dt": "d", "data": D5},
            "distortion_type": 0,
            "camera_group": k * group,
            "img_width": 640,
            "img_height": 480,
            "camera_pose_matrix": {"rows": 4, "cols": 4, "dt": "d", "data": np.ravel(pose).tolist()},
        }
        for k, pose in enumerate(poses)
    }
    return {"nb_camera": len(poses), **cameras}


def calib_io(r: list[float], t: list[float]) -> Any:
    (one,) = MET["calib.io"][0]["Calibration"]["cameras"]
    turn, shift = dict(zip(("rx", "ry", "rz"), r, strict=True)), dict(zip("xyz", t, strict=True))
    return {**one, "transform": {"rotation": turn, "translation": shift}}


ONE = {"K": K, "dist": [D5], "image_size": [640, 480], "model": "standard"}
TURNED = np.array(R) @ POINT + SHIFT
BACK = np.array(R).T @ (POINT - SHIFT)
# Of each kind of rig: the tree, the coefficients, and where further cameras see the point of the first.
RIGS: dict[str, tuple[Any, list[float], list[Array]]] = {
    "two mappings": (
        {"left": {"K": K, "D": D5}, "right": {"K": K, "D": D5}, "R": R, "T": [[t] for t in SHIFT]},
        D5,
        [TURNED],
    ),
    "two sides": (
        {
            f"{side}_{key}": value
            for side in ("left", "right")
            for key, value in (("camera_matrix", K), ("distortion", D5))
        }
        | {"R": R, "T": SHIFT},
        D5,
        [TURNED],
    ),
    "a mapping of the pose": (
        {"cam1": {"K": K, "D": D5}, "cam2": {"K": K, "D": D5}, "stereo": {"R": R, "T": SHIFT}},
        D5,
        [TURNED],
    ),
    "Argoverse": (
        {
            "camera_data_": [
                {"key": f"image_raw_{k}", "value": argoverse(R_, t_)}
                for k, (R_, t_) in enumerate(((np.eye(3), np.zeros(3)), (np.array(R), np.array(SHIFT))))
            ],
            "vehicle_SE3_up_lidar_": {},
        },
        [*D5[:2], 0, 0, D5[4]],
        [TURNED],
    ),
    "nuScenes": (
        [
            nuscenes("CAM_0", np.eye(3), np.zeros(3)),
            {**nuscenes("LIDAR", np.eye(3), np.zeros(3)), **EMPTY},
            nuscenes("CAM_1", np.array(R), np.array(SHIFT)),
        ],
        [],
        [TURNED],
    ),
    "entries of two sides": (
        {f"{side}_intrinsics": {**FXY, **NAMED} for side in ("left", "right")} | {"R": R, "T": SHIFT},
        D5,
        [TURNED],
    ),
    "calib.io": (
        {"Calibration": {"cameras": [calib_io([0, 0, 0], [0, 0, 0]), calib_io(TURN, SHIFT)]}},
        D8,
        [TURNED],
    ),
    "sides in mappings": (
        {"left": {"mtx": K, "dist": D5}, "right": {"mtx": K, "dist": D5}, "stereo": {"R": R, "T": SHIFT}},
        D5,
        [TURNED],
    ),
    "multical": (
        {
            "cameras": {"a": ONE, "b": ONE, "c": ONE},
            "camera_poses": {
                "c_to_b": {"R": R, "T": SHIFT},
                "a": {"R": np.eye(3).tolist(), "T": [0, 0, 0]},
                "b_to_a": {"R": R, "T": SHIFT},
            },
        },
        D5,
        [TURNED, np.array(R) @ TURNED + SHIFT],
    ),
    "MC-Calib": (
        mc_calib(EYE, np.linalg.inv(np.vstack([np.column_stack([R, SHIFT]), EYE[3]])).tolist()),
        D5,
        [TURNED],
    ),
    "OAK": (
        {"boardName": "x", "cameraData": [oak(2, 1, SHIFT), oak(1, 0, SHIFT), oak(0, -1, [0, 0, 0])]},
        D8,
        [BACK, np.array(R).T @ (BACK - SHIFT)],
    ),
}


@pytest.mark.parametrize("kind", RIGS)
def test_the_cameras_of_a_rig_lie_as_it_says(kind: str, tmp_path: Path) -> None:
    content, lens, points = RIGS[kind]
    found = read_cameras([written(content, tmp_path)])
    for camera in found.cameras:
        check(camera, E, lens)
    for pose, point in zip(found.relative, points, strict=True):
        assert np.abs(pose.to_camera(POINT) - point).max() < 1e-9


def test_a_pair_of_middlebury_lies_along_its_baseline(tmp_path: Path) -> None:
    text = (
        "cam0=[800.5 0 321.3; 0 800.5 238.7; 0 0 1]\ncam1=[800.5 0 351.3; 0 800.5 238.7; 0 0 1]\ndoffs=30\n"
    )
    found = read_cameras([written(f"{text}baseline=193.001\nwidth=640\nheight=480\nndisp=290\n", tmp_path)])
    for camera, cx in zip(found.cameras, (321.3, 351.3), strict=True):
        check(camera, [800.5, 0, 800.5, cx, 238.7], [])
        assert camera.image_size == S
    assert np.abs(found.relative[0].to_camera(POINT) - (POINT - [193.001, 0, 0])).max() < 1e-12


def test_two_files_of_easymocap_are_a_rig(tmp_path: Path) -> None:
    matrix = "{}: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: {}\n"
    head = '%YAML:1.0\n---\nnames:\n   - "1"\n   - "2"\n'
    parts = [matrix.format(f"K_{k}", 3, 3, FLAT) + matrix.format(f"dist_{k}", 1, 5, D5) for k in "12"]
    (tmp_path / "intri.yml").write_text(head + "".join(parts))
    poses = (np.eye(3).tolist(), [0.0, 0, 0]), (R, SHIFT)
    parts = [
        matrix.format(f"Rot_{k}", 3, 3, np.ravel(rotation).tolist()) + matrix.format(f"T_{k}", 3, 1, t)
        for k, (rotation, t) in zip("12", poses, strict=True)
    ]
    (tmp_path / "extri.yml").write_text(head + "".join(parts))
    found = read_cameras([tmp_path / "extri.yml", tmp_path / "intri.yml"])
    check(found.cameras[1], E, D5)
    assert np.abs(found.relative[0].to_camera(POINT) - TURNED).max() < 1e-9
    with pytest.raises(FormatError, match=r"give intri\.yml and extri\.yml"):
        read_cameras([tmp_path / "intri.yml"])


def test_the_polynomial_of_ocamcalib_becomes_the_nearest_fisheye(tmp_path: Path) -> None:
    pol, centre, (c, d, e) = [-289.0, 0.0, 1.5e-3, -3.1e-6, 7.2e-9], (391.0, 423.5), (0.998, 0.012, -0.011)
    rows = [[5, *pol], [2, 400, 200], centre, (c, d, e), (800, 848)]
    blocks = [
        "polynomial coefficients for the DIRECT mapping function",
        "inverse",
        "center",
        "affine",
        "size",
    ]
    text = "".join(f"#{b}\n\n{' '.join(map(repr, row))}\n\n" for b, row in zip(blocks, rows, strict=True))
    notes: list[str] = []
    warnings: list[str] = []
    (camera,) = read_cameras([written(text, tmp_path)], notes, warnings).cameras
    assert "the nearest fisheye moves pixels by" in warnings[0]
    stated = float(warnings[0].split(" moves pixels by ")[1].split()[0])
    pixels = np.random.default_rng(1).uniform([0, 0], [847, 799], (500, 2))
    row, column = pixels[:, 1] - centre[0], pixels[:, 0] - centre[1]
    x, y = (row - d * column) / (c - d * e), (c * column - e * row) / (c - d * e)
    rays = np.column_stack([y, x, -np.polyval(pol[::-1], np.hypot(x, y))])
    rays = np.array([rotated([0, 0, np.arctan2(d, c)], ray) for ray in rays])
    error = np.hypot(*(camera.project(rays)[0] - pixels).T).max()
    assert error < 1.1 * stated < 2.0
    assert "turned about its axis by 0.689 degrees" in notes[0]


def test_the_fov_of_dso_becomes_the_nearest_fisheye(tmp_path: Path) -> None:
    warnings: list[str] = []
    text = "0.535719 0.669567 0.493249 0.500409 0.897966\n1280 1024\ncrop\n640 480\n"
    (camera,) = read_cameras([written(text, tmp_path)], warnings=warnings).cameras
    assert "moves pixels by 2.7e-05 px at most" in warnings[0]
    theta, phi = np.random.default_rng(1).uniform(0.0, [[0.9], [6.28]], (2, 99))
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    bent = np.arctan(2 * np.tan(theta) * np.tan(0.897966 / 2)) / 0.897966
    f, c = np.array([0.535719 * 1280, 0.669567 * 1024]), np.array([0.493249 * 1280, 0.500409 * 1024]) - 0.5
    expected = f * np.column_stack([np.cos(phi), np.sin(phi)]) * bent[:, None] + c
    assert np.abs(camera.project(rays)[0] - expected).max() < 1e-4


MANY = [{"camera_intrinsic": [[1266.4 + k, 0, 816.2], [0, 1266.4, 491.5], [0, 0, 1]]} for k in range(3)]
REFUSED: dict[str, tuple[Any, str]] = {
    "nuScenes": (MANY, "holds several cameras (0, 1, 2)"),
    "groups of MC-Calib": (mc_calib(EYE, EYE, group=1), "have no pose between them; save one as a file"),
    "no size": ({"camera_angle_x": 0.69, "frames": [frame(1)]}, "give --image-size W H"),
    "VINS-Fusion": ('%YAML:1.0\ncam0_calib: "a.yaml"\nbody_T_cam0: 1\n', "names the files of its cameras"),
    "one focal length and a ratio": (
        {"focal_length": 800.5, "aspect_ratio": 1.01, "principal_point": [320, 240], **WH},
        "which programs take as fy / fx or fx / fy",
    ),
    "coefficients beside it": ({"rgb": {"K": K}, "rgb_distortion": NAMED}, "may be the distortion"),
    "a coefficient with another name": ({"K": K, "lens_k1": -0.3}, "'lens_k1' may be the distortion"),
    "one of two distortions": (
        {"K1": K, "K2": K, "D1": D5, "lens 2": D5, "R": R, "T": SHIFT},
        "the camera '2' has no distortion coefficients under a known name",
    ),
    "an unknown coefficient": ({"K": K, "distortion": {"k1": -0.3, "m2": 0.1}}, "'m2' may be the distortion"),
    "packed numbers": ({"K": K, "lens_distortion_table": "AbCd" * 40}, "may be the distortion"),
    "several streams": (
        STREAM.format("Color", "None", "0 0 0 0 0")
        + STREAM.format("Fisheye", "Kannala Brandt4", "0.1 0 0 0"),
        "holds several cameras of RealSense (Color 640x480, Fisheye 640x480)",
    ),
    "a stream that is undistorted": (
        STREAM.format("Color", "Inverse Brown Conrady", "0.1 0 0 0 0"),
        "Inverse Brown Conrady of RealSense is not known",
    ),
    "an old pickle": ("(dp0\nVmtx\np1\n(lp2\nF1.0\nas.", "is a pickle of Python"),
    "messages that differ": (
        "".join(f"header:\n  seq: {k}\n{ECHO.replace('480', str(480 + k))}---\n" for k in range(2)),
        "a second YAML document begins",
    ),
    "transposed": ({"camera_matrix": np.array(K).T.tolist()}, "is transposed, as MATLAB writes it"),
    "mm": (
        {"focal_length": 35, "principal_point": [320, 240], "image_size": [640, 480]},
        "not told to be in pixels",
    ),
    "two focal lengths": ({"K": K, **FXY, "fx": 808.5}, "K and fx, fy, cx, cy differ, and both may be meant"),
    "two focal lengths of MATLAB": (
        {**MATLAB, "K": [[810.5, 0, 322.3], [0, 801.25, 239.7], [0, 0, 1]]},
        "FocalLength, PrincipalPoint and the matrix differ",
    ),
    "a focal length that is no number": ({"f": "800.5-", "cx": 321.3, "cy": 238.7}, "f must be a number"),
    "an unknown focal length": ({"f": None, "cx": 321.3, "cy": 238.7}, "has no focal length"),
    "four numbers that are none": (
        {"K": K, "lens": [float("nan"), float("inf"), 1, 2]},
        "'lens' may be the distortion",
    ),
    "numbered coefficients": (
        {"K": K, "radial_distortion_1": -0.3, "radial_distortion_2": 0.1},
        "'radial_distortion_1' may be the distortion",
    ),
    "kappa": ({"K": K, "kappa1": -0.3}, "'kappa1' may be the distortion"),
    "an inverse distortion alone": ({"K": K, "undistortion_coefficients": D5}, "may be the distortion"),
    "a division model": (
        {"model": "division", "K": K, "strength": -1e-7},
        "'strength' may be the distortion",
    ),
    "mm of a sensor": ({"fx": 4.1, "fy": 4.1, "cx": 3.2, "cy": 2.4}, "is not in pixels, but in mm"),
    "two sizes": (
        {"K": K, "image_size": [640, 480], **WH, "width": 1280},
        "image_size and width, height differ",
    ),
    "HALCON": (
        '# CAMERA\nParGroup: Cam1: "Internal"\n\nFocus:foc: 0.008;\n',
        "is a camera of HALCON in metres",
    ),
    "Pix4D": ("Pix4D camera calibration file 0\nF 4.7\nPx 3.08\n", "is a camera of Pix4D in mm"),
    "Vicon": (
        '<?xml version="1.0"?>\n<Cameras><Camera><KeyFrames><KeyFrame FOCAL_LENGTH="1728" '
        'VICON_RADIAL2="ViconRadial2 0 0 1e-8 1e-15 0"/></KeyFrames></Camera></Cameras>',
        "is a calibration of Vicon",
    ),
    "Qualisys": (
        "<?xml version='1.0'?>\n<calibration created='x' qtm-version='2024.3'><cameras/></calibration>",
        "is a calibration of Qualisys, in 1/64",
    ),
    "OptiTrack": ('<?xml version="1.0"?><Profile><Intrinsic KC1="1"/></Profile>', "of OptiTrack's Motive"),
    "VideoPose3D": (
        {"center": [1, 2], "focal_length": [3, 4], "tangential_distortion": [0, 1], "res_w": 1000},
        "holds cameras of Human3.6M (VideoPose3D)",
    ),
    "ContextCapture": ('<?xml version="1.0"?><OpticalProperties version="1.0"/>', "ContextCapture (iTwin)"),
    "MicMac": ('<?xml version="1.0" ?><ExportAPERO/>', "is a camera of MicMac"),
    "fSpy": ({"relativeFocalLength": 1.9, "viewTransform": {}}, "is a camera of fSpy"),
    "Aria": ({"CameraCalibrations": []}, "is a calibration of Project Aria"),
    "Apple": (
        {"intrinsic_matrix": K, "lens_distortion_lookup_table": [0.0, 0.01]},
        "AVFoundation, whose distortion is a table",
    ),
    "Unreal": ({"cameraParameterTables": []}, "is a lens of Unreal"),
    "ScanNet": (
        "m_versionNumber = 4\nm_calibrationColorIntrinsic = 1170 0 647 0 0 1170 483 0 0 0 1 0 0 0 0 1\n",
        "give intrinsic_color.txt",
    ),
    "AprilCal": ("aprilCameraCalibration {\n names = [ a ];\n}\n", "is a configuration of AprilCal"),
    "DJI": (f"Dewarp Data : {DEWARP}\n", "give --image-size W H"),
    "a damaged image of Pix4D": (PIX4D.replace("0 0 1\n", "0 0\n", 1), "is damaged; export the file again"),
    "Bundler": ("# Bundle file v0.3\n1 0\n800 0 0\n", "is a model of Bundler"),
    "VisualSFM": ("NVM_V3 \n\n1\na.jpg 800 1 0 0 0 0 0 0 0 0\n", "is a model of VisualSFM"),
    "RealityCapture": (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><a xmlns:xcr="http://www.capturingreality.com/ns"/></x:xmpmeta>',
        "is a camera of RealityCapture",
    ),
    "OpenPTV": ("0.0001 0.0 0.0 0.0 0.0 1.0 0.0\n", "is the distortion of a camera of OpenPTV"),
    "equirectangular": (
        lines("Camera:\n", "  ", setup="a", model="equirectangular", fx=1, fy=1, cx=1, cy=1),
        "the model 'equirectangular' of OpenVSLAM is not known",
    ),
    "several of OpenSfM": (
        {
            k: {"projection_type": "perspective", **WH, "focal": f, "k1": 0, "k2": 0}
            for k, f in (("a", 0.8), ("b", 0.9))
        },
        "holds several cameras of OpenSfM (a, b)",
    ),
    "Kinect": (KINECT, "convert that of one with --image-size: 1280 720"),
    "p1 of a fisheye": (
        metashape("fisheye", "<p1>0.1</p1>"),
        "the key 'p1' is not known in Metashape's fisheye",
    ),
    "matrices of several cameras": (
        {"intrinsic_matrices": [K, np.add(K, 1).tolist()], "distortion_coeffs": [D5, D5]},
        "holds the matrices of 2 cameras, intrinsic_matrices",
    ),
    "four of KWIVER": (
        "800 0 320\n0 801 240\n0 0 1\n1 0 0\n0 1 0\n0 0 1\n0 0 3\n1 2 3 4\n",
        "may be k1, k2, p1",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_read_is_named(kind: str, tmp_path: Path) -> None:
    content, message = REFUSED[kind]
    with pytest.raises(FormatError) as caught:
        read_points_or_cameras([written(content, tmp_path)])
    assert message in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("start", ["# a\n\n", "\n", "-", "1 ", " ", "[", "a = 1\n", "'"])
def test_the_time_to_refuse_a_file_does_not_explode_with_its_length(start: str, tmp_path: Path) -> None:
    path = tmp_path / "notes.toml"
    for end in ("", "\n!", "\nA sentence: it ends here."):
        path.write_text(50 * start + end)
        began = time.process_time()
        with contextlib.suppress(NeurocalError):
            read_points_or_cameras([path])
        assert time.process_time() - began < 2


def test_the_camera_in_a_photograph_of_a_dji_is_read(tmp_path: Path) -> None:
    import cv2

    (tmp_path / "a.xmp").write_text(f'<x:xmpmeta drone-dji:DewarpData="{DEWARP}"/>')
    check(read_cameras([tmp_path / "a.xmp"], size=S).cameras[0], E, D5)
    image = cv2.imencode(".jpg", np.zeros((480, 640, 3), np.uint8))[1].tobytes()
    data = b"http://ns.adobe.com/xap/1.0/\0" + (tmp_path / "a.xmp").read_bytes()
    data = b"\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data
    (tmp_path / "a.jpg").write_bytes(image[:2] + data + image[2:])
    camera = read_cameras([tmp_path / "a.jpg"]).cameras[0]
    check(camera, E, D5)
    assert camera.image_size == S


def test_the_poses_of_pix4d_are_those_of_its_images(tmp_path: Path) -> None:
    found = read_cameras([written(PIX4D, tmp_path)])
    assert list(found.poses) == ["a photo 3.jpg", "a photo 4.jpg"]
    assert found.poses["a photo 3.jpg"].to_camera(np.array([[2.0, 2, -7]])).tolist() == [[1, 0, 10]]


def test_the_polynomial_of_woodscape_is_the_nearest_fisheye(tmp_path: Path) -> None:
    k, offset = [339.749, -31.988, 48.275, -7.201], [3.942, -3.093]
    own = {"model": "radial_poly", "poly_order": 4, "width": 1280.0, "height": 966.0, "aspect_ratio": 1.0}
    own |= {f"k{n}": one for n, one in enumerate(k, 1)} | dict(
        zip(("cx_offset", "cy_offset"), offset, strict=True)
    )
    body = {"quaternion": Rotation.from_rotvec(TURN).as_quat().tolist(), "translation": [1.0, 2.0, 3.0]}
    warnings: list[str] = []
    tree = {"intrinsic": own, "extrinsic": body, "name": "FV"}
    found = read_cameras([written(tree, tmp_path)], warnings=warnings)
    theta, phi = np.linspace(0.01, 1.5, 50), np.linspace(0, 6, 50)
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    radius = np.polynomial.polynomial.polyval(theta, [0, *k])
    middle = np.array([639.5, 482.5]) + offset
    expected = middle + radius[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    assert np.abs(found.cameras[0].project(rays)[0] - expected).max() < 0.6
    assert "moves pixels by 0.5" in warnings[0]
    (pose,) = found.poses.values()
    point = np.add(Rotation.from_rotvec(TURN).apply([0.1, 0.2, 5.0]), [1.0, 2.0, 3.0])
    assert np.abs(pose.to_camera(point[None]) - [0.1, 0.2, 5.0]).max() < 1e-12


@pytest.mark.parametrize("tree", [{"mtx": K, "dist": [D5]}, {"cameraMatrix": K, "distCoeffs": [D5], "fx": 3}])
def test_matrices_that_python_saved_for_matlab_begin_at_zero_with_a_warning(
    tree: Any, tmp_path: Path
) -> None:
    savemat(tmp_path / "camera.mat", tree)
    warnings: list[str] = []
    check(read_cameras([tmp_path / "camera.mat"], warnings=warnings).cameras[0], E, D5)
    assert "its first pixel is taken as 0" in warnings[0]


def test_a_region_of_interest_of_ros_is_told(tmp_path: Path) -> None:
    region = ECHO + "roi: {x_offset: 100, y_offset: 50, height: 240, width: 320, do_rectify: false}\n"
    (tmp_path / "a.yaml").write_text(region)
    notes: list[str] = []
    found = read_cameras([tmp_path / "a.yaml"], notes)
    assert found.cameras[0].image_size == (640, 480)
    assert any("neurocal resize CAMERA.yaml --crop 100 50 320 240" in note for note in notes)


def test_dictionaries_of_anipose_in_a_list_are_a_rig(tmp_path: Path) -> None:
    cameras = [
        {"name": name, "size": [640, 480], "matrix": K, "distortions": D5, "rotation": turn, "translation": t}
        for name, turn, t in (("c01", [0, 0, 0], [0, 0, 0]), ("c02", [0, 0.3, 0], [-110, 1, 20]))
    ]
    (tmp_path / "a.json").write_text(json.dumps(cameras))
    found = read_cameras([tmp_path / "a.json"])
    check(found.cameras[1], E, D5)
    assert [camera.name for camera in found.cameras] == ["c01", "c02"]
    assert found.relative[0].t.tolist() == [-110, 1, 20]


def test_a_struct_of_matlab_may_have_any_name_if_it_is_the_only_one(tmp_path: Path) -> None:
    struct = {"K": np.add(K, [[0, 0, 1], [0, 0, 1], [0, 0, 0]]), "RadialDistortion": D5[:2]}
    struct["TangentialDistortion"] = D5[2:4]
    savemat(tmp_path / "one.mat", {"myCamera": struct, "meanError": 0.2})
    check(read_cameras([tmp_path / "one.mat"]).cameras[0], E, D4)
    savemat(tmp_path / "two.mat", {"left": struct, "right": struct})
    with pytest.raises(FormatError, match="holds no camera that can be read"):
        read_cameras([tmp_path / "two.mat"])


def test_the_parameters_of_dannce_are_matlab_s(tmp_path: Path) -> None:
    shifted = np.add(K, [[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    savemat(tmp_path / "a.mat", {"K": shifted.T, "RDistort": D5[:2], "TDistort": D5[2:4], "r": R, "t": SHIFT})
    check(read_cameras([tmp_path / "a.mat"]).cameras[0], E, D4)


def test_an_array_that_is_no_camera_matrix_is_told(tmp_path: Path) -> None:
    np.save(tmp_path / "D.npy", [D5])
    with pytest.raises(FormatError, match="is an array of 1 x 5 numbers; give the camera matrix"):
        read_cameras([tmp_path / "D.npy"])


@pytest.mark.parametrize(("ending", "packed"), [(".yml", 64), (".json", 64), (".xml", 64), (".yml.gz", 0)])
def test_opencv_s_packed_files_are_read(ending: str, packed: int, tmp_path: Path) -> None:
    import cv2

    file = cv2.FileStorage(str(tmp_path / f"a{ending}"), cv2.FILE_STORAGE_WRITE | packed)
    file.write("camera_matrix", np.array(K))
    file.write("distortion_coefficients", np.array([D5]))
    file.release()
    check(read_cameras([tmp_path / f"a{ending}"]).cameras[0], E, D5)


def openptv(folder: Path, centre: tuple[float, float], lens: list[float], glass: float) -> Path:
    """Files of a camera of 640 x 480 pixels of 0.01 mm at (10, 20, 300), which looks along -z."""
    (folder / "cal").mkdir()
    (folder / "parameters").mkdir()
    names = "img/a\ncal/a.tif\nimg/b\ncal/b.tif\n"
    (folder / "parameters" / "ptv.par").write_text(
        f"2\n{names}1\n0\n1\n640\n480\n0.01\n0.01\n0\n1\n{glass}\n{glass}\n5\n"
    )
    (folder / "cal" / "a.tif.addpar").write_text(" ".join(map(str, lens)))
    angle = np.cos(0.3), np.sin(0.3)
    dm = [[angle[0], 0, angle[1]], [0, 1, 0], [-angle[1], 0, angle[0]]]
    rows = [
        "10 20 300",
        "0 0.3 0",
        "",
        *(" ".join(map(str, row)) for row in dm),
        "",
        f"{centre[0]} {centre[1]}",
        "8.0",
        "",
        "0 0 50",
    ]
    (folder / "cal" / "a.tif.ori").write_text("\n".join(rows) + "\n")
    return folder / "cal" / "a.tif.ori"


@pytest.mark.parametrize(("centre", "most"), [((0.0, 0.0), 1e-3), ((0.12, -0.07), 0.02)])
def test_a_camera_of_openptv_projects_as_its_formulas(
    centre: tuple[float, float], most: float, tmp_path: Path
) -> None:
    k1, k2, k3, p1, p2, scale, shear = lens = [-2e-3, 4e-6, 0.0, 1e-5, -2e-5, 1.002, 0.001]
    warnings: list[str] = []
    found = read_points_or_cameras([openptv(tmp_path, centre, lens, 1.0)], warnings=warnings)
    assert isinstance(found, CameraSet)
    assert [w for w in warnings if "nearest camera" in w] == warnings[:1] if centre[0] else not warnings
    assert found.cameras[0].image_size == S
    world = np.random.default_rng(1).uniform([-110, -60, -40], [60, 90, 40], (200, 3))
    dm = np.array([[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]])
    X, Y, Z = ((world - [10, 20, 300]) @ dm).T
    x, y = -8.0 * X / Z + centre[0], -8.0 * Y / Z + centre[1]
    r = np.hypot(x, y)
    radial = k1 * r**2 + k2 * r**4 + k3 * r**6
    x, y = (
        x + x * radial + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y,
        y + y * radial + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y,
    )
    x, y = scale * x - np.sin(shear) * y, np.cos(shear) * y
    pixels = np.column_stack([x / 0.01 + 320, 240 - y / 0.01]) - 0.5
    inside = ((pixels > 0) & (pixels < S)).all(axis=1)
    assert inside.sum() > 50
    (pose,) = found.poses.values()
    got = found.cameras[0].project(pose.to_camera(world))[0]
    assert np.abs(got - pixels)[inside].max() < most


def test_the_pixels_of_openptv_are_in_the_runs_of_pyptv_too(tmp_path: Path) -> None:
    place = openptv(tmp_path, (0.1, 0.0), [0, 0, 0, 0, 0, 1, 0], 1.0)
    known = read_cameras([place]).cameras[0]
    (tmp_path / "parameters" / "ptv.par").unlink()
    run = {"imx": 640, "imy": 480, "pix_x": 0.01, "pix_y": 0.01, "mmp_n1": 1.0, "mmp_n2": 1.0, "mmp_n3": 1.0}
    (tmp_path / "parameters_Run1.yaml").write_text(json.dumps({"ptv": run}))
    found = read_cameras([place]).cameras[0]
    assert (found.intrinsics, found.image_size) == (known.intrinsics, known.image_size)
    (tmp_path / "parameters_Run2.yaml").write_text(json.dumps({"ptv": {**run, "pix_y": 0.02}}))
    with pytest.raises(FormatError, match=r"Run1\.yaml, parameters_Run2\.yaml differ in the pixels"):
        read_cameras([place])


def test_the_pose_behind_glass_and_a_lack_of_pixels_are_told(tmp_path: Path) -> None:
    place = openptv(tmp_path, (0.0, 0.0), [0, 0, 0, 0, 0, 1, 0], 1.33)
    notes: list[str] = []
    assert not read_cameras([place], notes).poses
    assert "rays are broken at glass" in notes[0]
    (tmp_path / "parameters" / "ptv.par").unlink()
    with pytest.raises(FormatError, match=r"put ptv\.par, which has the size of the pixels"):
        read_cameras([place])


def test_a_principal_point_from_the_middle_is_told(tmp_path: Path) -> None:
    warnings: list[str] = []
    read_cameras([written({**FXY, "cx": 1.8, "cy": -0.8, **WH}, tmp_path)], warnings=warnings)
    assert "(1.8, -0.8) is in the corner of an image of 640 x 480; if it is counted from" in warnings[0]


def test_another_camera_matrix_is_told(tmp_path: Path) -> None:
    notes: list[str] = []
    check(
        read_cameras(
            [written({"K": K, "K_depth": HALVED, "D": D5, "observations": []}, tmp_path)], notes
        ).cameras[0],
        E,
        D5,
    )
    assert "'K_depth' looks like another camera matrix, and is not read" in notes[0]


@pytest.mark.parametrize("text", ["iVBORw0KGgo", "a ", "[1, ", "\n", "k = [1, 2", "x: 1\n", "1 "])
def test_a_long_text_without_a_camera_is_refused_at_once(text: str, tmp_path: Path) -> None:
    # Patterns that go back over the text would take minutes for it.
    with pytest.raises(FormatError):
        read_cameras([written(text * (60_000 // len(text)), tmp_path)])


def test_a_mistake_in_one_of_several_cameras_names_it(tmp_path: Path) -> None:
    one = "S_{0}: {1}\nK_{0}: 700 0 600 0 700 180 0 0 1\nD_{0}: 0 0 0 0 0\n"
    one += "R_{0}: 1 0 0 0 1 0 0 0 1\nT_{0}: {0} 0 0\n"
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text("calib_time: 09-Jan-2012\n" + one.format("00", "1242 375") + one.format("01", "1242"))
    with pytest.raises(FormatError, match=r"image_01.S must be two whole numbers"):
        read_cameras([path])
