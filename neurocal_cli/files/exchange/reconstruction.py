"""Formats of reconstruction and visual servoing: Metashape, OpenMVG, AliceVision, OpenSfM, Pix4D, ViSP.

Their files hold the cameras of a whole project; one camera is read, or the one that all are alike.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import xml_root
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.exchange.format_table import Format, PoseKeys, Tree
from neurocal_cli.files.exchange.tree_paths import in_rows
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import plain_value


# Agisoft Metashape: f in pixels, the principal point from the middle of the image, p1 and p2 exchanged. A
# fisheye has the same polynomial of the angle. Projects hold the same elements for each sensor.
def _metashape_part(tree: Mapping[str, Any], source: str) -> Field:
    root = Field({"projection": "frame", **tree}, source)
    width, height = root["width"].integer(1), root["height"].integer(1)
    f = root["f"].number() if "f" in root else root["fy"].number()
    edge = (0.0, 0.0) if "f" in root else (0.5 * width, 0.5 * height)  # older versions count from it
    own = {
        "fx": (root["fx"].number() if "fx" in root else f) + root.get("b1", 0.0).number(),
        "fy": f,
        "cx": root.get("cx", 0.0).number() - edge[0],
        "cy": root.get("cy", 0.0).number() - edge[1],
        "b2": root.get("b2", 0.0).number() + root.get("skew", 0.0).number(),
    }
    return Field({**root.value, **own}, source)


def _metashape_parts(document: Document) -> dict[str, Field]:
    if "calibration" in document.tree:
        return {"camera": _metashape_part(document.root["calibration"].value, document.source)}
    parts = {}
    for sensor in xml_root(document.text, document.source).iter("sensor"):
        adjusted = [
            one for one in sensor.findall("calibration") if one.get("class", "adjusted") == "adjusted"
        ]
        for found in adjusted[-1:]:
            size = found.find("resolution")
            size = sensor.find("resolution") if size is None else size
            tree = {child.tag: child.text for child in found if child.tag != "resolution"}
            tree |= {} if size is None else dict(size.attrib)
            sides = {
                side: int(tree[side] or 0) for side in ("width", "height") if str(tree.get(side)).isdigit()
            }
            kind = found.get("type") or sensor.get("type") or "frame"
            name = sensor.get("label") or f"sensor {sensor.get('id')}"
            parts[name] = _metashape_part({**tree, **sides, "projection": kind}, document.source)
    return parts


def _agisoft(tree: Tree) -> str:
    tree |= {"f": tree["fy"], "b1": tree["fx"] - tree["fy"]}
    if tree["projection"] != "frame":
        tree["projection"] = "equidistant_fisheye"
    order = ("projection", "width", "height", "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
    body = "\n".join(f"  <{key}>{tree[key]}</{key}>" for key in order if key in tree)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n{body}\n</calibration>\n'


METASHAPE = Format(
    "Metashape",
    "fx,fy,cx,cy",
    """
    frame: plumb_bob k1,k2,p2,p1,k3
    fisheye, equidistant_fisheye: fisheye *
    """,
    model="projection",
    size="width,height",
    skew="b2",
    first_pixel=0.5,
    from_middle=True,
    optional="any",
    aside="f b1 skew date",
    complete=True,
    told=lambda document: (
        ("<calibration" in document.text[:1000] and "calibration" in document.tree)
        or ("<document" in document.text[:1000] and "<sensor" in document.text)
    ),
    files="Agisoft calibration, doc.xml of a project, or exported cameras: XML",
    parts=_metashape_parts,
    project=True,
    write=_agisoft,
    needs_size=True,
)


# ViSP's cameras, each with several models of one calibration: the last one has the distortion.
def _visp_parts(document: Document) -> dict[str, Tree]:
    parts = {}
    for k, camera in enumerate(xml_root(document.text, document.source).iter("camera")):
        own = {child.tag: plain_value(child.text or "") for child in camera if not len(child)}
        models = camera.findall("model")
        if len(models) > 1:
            document.note("holds the camera without distortion as well, which is passed over")
        for model in models[-1:]:
            tree = own | {child.tag: plain_value(child.text or "") for child in model}
            parts[f"{own.get('name', 'camera')} {k}"] = tree
    return parts


VISP = Format(
    "ViSP",
    "px,py,u0,v0",
    """
    perspectiveProjWithoutDistortion: none
    perspectiveProjWithDistortion: k1 kud
    ProjWithKannalaBrandtDistortion: fisheye *
    """,
    model="type",
    size="image_width,image_height",
    told=lambda document: re.search(r"<type>\s*(perspectiveP|P)rojWith", document.text[:100_000]),
    files="cameras of vpXmlParserCamera, XML",
    parts=_visp_parts,
    project=True,
)


# OpenMVG's sfm_data.json. The name of a model stands where it is first used, its number everywhere.
def _openmvg_parts(document: Document) -> dict[str, Field]:
    names: dict[int, str] = {}
    parts = {}
    for entry in document.root["intrinsics"].items():
        value = entry["value"]
        number = value["polymorphic_id"].integer() & 0x7FFFFFFF
        names[number] = value.get("polymorphic_name", names.get(number, "")).text()
        data = value["ptr_wrapper"]["data"]
        tree = {**data.value, **data.get("value0", {}).value, "model": names[number]}
        parts[f"intrinsic {entry['key'].text()}"] = Field(tree, data.source, data.path)
    return parts


OPENMVG = Format(
    "OpenMVG",
    "focal_length focal_length principal_point/0,1",
    """
    pinhole: none
    pinhole_radial_k1: k1 disto_k1/0
    pinhole_radial_k3: plumb_bob disto_k3/0-1 - - disto_k3/2
    pinhole_brown_t2: plumb_bob disto_t2/0,1,3,4,2
    fisheye: fisheye fisheye/0-3
    """,
    model="model",
    size="width,height",
    told="sfm_data_version intrinsics",
    files="sfm_data.json",
    parts=_openmvg_parts,
    project=True,
)


# AliceVision and Meshroom: texts in place of numbers, the focal length in mm since version 1.2.2, and the
# principal point from the middle of the image since 1.2.1.
def _alicevision_parts(document: Document) -> dict[str, Field]:
    version = document.root["version"].array(3).tolist()
    parts = {}
    for entry in document.root["intrinsics"].items():
        size = int(entry["width"].number()), int(entry["height"].number())
        c = [entry["principalPoint"].array(2)[k] + (version >= [1, 2, 1]) * 0.5 * size[k] for k in (0, 1)]
        if version < [1, 2, 2]:
            f = entry["pxFocalLength"].value
            fx, fy = (2 * [Field(f, entry.source, "pxFocalLength").number()] if isinstance(f, str)
                      else entry["pxFocalLength"].array(2).tolist())  # fmt: skip
        else:
            fx = entry["focalLength"].number() / entry["sensorWidth"].number() * size[0]
            ratio = entry["pixelRatio"].number()
            fy = fx * ratio if version >= [1, 2, 5] else fx / ratio
        kind, lens = entry["type"].text(), entry.get("distortionType", "").text()
        tree = {"fx": fx, "fy": fy, "cx": c[0], "cy": c[1], "model": lens if kind == "pinhole" else kind}
        tree = {**entry.value, **tree, "size": list(size)}
        parts[f"intrinsic {entry['intrinsicId'].text()}"] = Field(tree, entry.source, entry.path)
    return parts


ALICEVISION = Format(
    "AliceVision",
    "fx,fy,cx,cy",
    """
    none, pinhole, : none
    radialk1, radial1: k1 distortionParams/0
    radialk3, radial3: plumb_bob distortionParams/0-1 - - distortionParams/2
    brown: plumb_bob distortionParams/0,1,3,4,2
    fisheye4: fisheye distortionParams/0-3
    """,
    model="model",
    size="size",
    told=lambda document: (
        "version" in document.tree and "intrinsicId" in str(document.tree.get("intrinsics"))[:2000]
    ),
    files="cameras.sfm of Meshroom, JSON",
    parts=_alicevision_parts,
    project=True,
)

# OpenSfM and OpenDroneMap: coordinates from the middle of the image, divided by its longer side.
_OLD, _CENTRED = {"projection_type": "perspective"}, {"c_x": 0.0, "c_y": 0.0}


def _opensfm(document: Document) -> dict[str, Field]:
    tree = document.tree
    alone = {"projection_type", "width", "height"} <= set(tree) and "focal" in str(tree)
    shots = {
        name: Field({**_OLD, **({} if "focal_x" in part else _CENTRED), **part}, document.source, name)
        for name, part in tree.items()
        if isinstance(part, dict) and {"focal", "focal_x"} & set(part) and {"width", "height"} <= set(part)
    }
    return shots or ({"": document.root} if alone else {})


OPENSFM = Format(
    "OpenSfM",
    "focal_x,focal_y,c_x,c_y",
    """
    perspective: k1k2 * of focal,focal,c_x,c_y
    simple_radial: k1 k1
    radial: k1k2 *
    brown: plumb_bob *
    fisheye: fisheye k1,k2 - - of focal,focal,c_x,c_y
    fisheye_opencv: fisheye *
    """,
    model="projection_type",
    size="width,height",
    first_pixel=0.5,
    from_middle=True,
    by_longer_side=True,
    told=_opensfm,
    files="cameras.json, reference of a camera model; also of OpenDroneMap",
    project=True,
)

# Pix4D's calibrated_camera_parameters.txt: of each image K, the distortion, and the pose, m = K [R|-Rt] X.
_PIX4D_HEAD = re.compile(r"\A\s*fileName imageWidth imageHeight\s.*?\[R\|-Rt\] X\s*\n", re.DOTALL).match


def _pix4d(document: Document) -> dict[str, Field]:
    if (head := _PIX4D_HEAD(document.text[:2000])) is None:
        return {}
    lines = [line for line in document.text[head.end() :].splitlines() if line.strip()]
    parts = {}
    for k in range(0, len(lines), 10):
        words = lines[k].split()
        name, block = " ".join(words[:-2]), "\n".join([" ".join(words[-2:]), *lines[k + 1 : k + 10]])
        found = in_rows("size:2,K:9/3,radial:3,tangential:2,t:3,R:9/3", block, document.source)
        if found is None or not name:
            raise InputError(f"the block of the image {name[:40]!r} is damaged; export the file again")
        parts[name] = found
    document.doubt(
        "Pix4D does not say where its first pixel is; its centre is taken as (0, 0), "
        "which may be half a pixel off"
    )
    return parts


PIX4D = Format(
    "Pix4D",
    "K",
    "plumb_bob radial/0-1 tangential/0-1 radial/2",
    size="size",
    told=_pix4d,
    files="calibrated_camera_parameters.txt",
    pose=PoseKeys("R t", centre=True),
    project=True,
    poses=True,
)
