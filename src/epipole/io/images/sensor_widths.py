"""Widths of common image sensors, for photographs whose EXIF has the focal length only in millimeters.

The width is the longer side of the sensor according to the manufacturer's data sheet.
"""

from types import MappingProxyType

from epipole._checks import checked

_WIDTH_MM_BY_MODELS: tuple[tuple[float, tuple[str, ...]], ...] = (
    # 36 x 24 mm
    (35.8, ("canon eos 5d", "canon eos 6d", "sony ilce-7", "sony ilce-7m2")),
    (35.9, ("canon eos 6d mark ii", "nikon d600", "nikon d610", "nikon d750", "nikon d800", "nikon d810")),
    (35.9, ("nikon d850", "nikon z 6", "nikon z 7", "sony ilce-7r", "sony ilce-7rm2", "sony ilce-7rm3")),
    (36.0, ("canon eos 5d mark ii", "canon eos 5d mark iii", "canon eos 5d mark iv", "canon eos r")),
    (36.0, ("canon eos r5", "nikon d3", "nikon d700")),
    # APS-C
    (22.7, ("canon eos 300d digital", "canon eos digital rebel")),
    (22.2, ("canon eos 350d digital", "canon eos digital rebel xt", "canon eos 400d digital")),
    (22.2, ("canon eos digital rebel xti", "canon eos 450d", "canon eos rebel xsi", "canon eos 40d")),
    (22.5, ("canon eos 20d", "canon eos 30d", "canon eos 70d")),
    (22.3, ("canon eos 50d", "canon eos 60d", "canon eos 7d", "canon eos 80d", "canon eos 500d")),
    (22.3, ("canon eos rebel t1i", "canon eos 550d", "canon eos rebel t2i", "canon eos 600d")),
    (22.3, ("canon eos rebel t3i", "canon eos 650d", "canon eos rebel t4i", "canon eos 700d")),
    (22.3, ("canon eos rebel t5i", "canon eos 750d", "canon eos rebel t6i")),
    (22.4, ("canon eos 7d mark ii",)),
    (23.7, ("nikon d40", "nikon d50", "nikon d70", "nikon d70s")),
    (23.6, ("nikon d60", "nikon d80", "nikon d90", "nikon d200", "nikon d300", "nikon d300s")),
    (23.6, ("nikon d3000", "nikon d5000", "nikon d5100", "nikon d7000")),
    (23.1, ("nikon d3100",)),
    (23.2, ("nikon d3200",)),
    (23.5, ("nikon d3300", "nikon d5200", "nikon d5300", "nikon d5500", "nikon d7100", "nikon d7200")),
    (23.5, ("nikon d500", "sony ilce-5100", "sony ilce-6000", "sony ilce-6300", "sony ilce-6500")),
    (23.5, ("sony nex-7",)),
    (23.6, ("sony dslr-a100", "fujifilm x100", "fujifilm x-t1", "fujifilm x-t2")),
    # Four Thirds
    (17.3, ("olympus e-m1", "olympus e-m5", "olympus e-m10", "panasonic dmc-gh3", "panasonic dmc-gh4")),
    (17.3, ("panasonic dmc-g7", "panasonic dmc-gx7", "dji fc550")),
    # 1 inch
    (13.2, ("sony dsc-rx100", "sony dsc-rx100m2", "sony dsc-rx100m3", "dji fc6310", "hasselblad l1d-20c")),
    # compact cameras and small drones: 1/1.7", 1/2.3", 1/2.5"
    (7.44, ("canon powershot g10", "canon powershot g12", "canon powershot s90", "canon powershot s95")),
    (6.17, ("dji fc220", "dji fc300x", "dji fc330", "dji fc350")),
    (5.75, ("canon powershot a540", "canon powershot s2 is", "canon powershot s3 is")),
    (5.75, ("canon powershot sd1000", "kodak z612 zoom digital camera")),
    # phones (pixel pitch x pixels of the main camera)
    (4.54, ("apple iphone 4",)),
    (4.89, ("apple iphone 5s", "apple iphone 6")),
    (4.57, ("samsung gt-i9100", "samsung gt-i9300", "google nexus 5", "lge nexus 5")),
    (5.95, ("samsung sm-g900f", "samsung sm-g920f")),
)

SENSOR_WIDTH_MM = MappingProxyType(
    {model: width for width, models in _WIDTH_MM_BY_MODELS for model in models}
)
"""Sensor width in millimeters by `camera_key`."""

_BRANDS = (
    "canon",
    "nikon",
    "sony",
    "fujifilm",
    "olympus",
    "panasonic",
    "dji",
    "hasselblad",
    "kodak",
    "apple",
    "samsung",
    "google",
    "lge",
)


@checked
def camera_key(make: str, model: str) -> str:
    """Write make and model as one lower-case name: ("NIKON CORPORATION", "NIKON D90") is "nikon d90"."""
    make, model = (" ".join(text.lower().split()) for text in (make, model))
    brand = next((b for b in _BRANDS if b in make), make)
    return model if not brand or model.startswith(brand) else f"{brand} {model}"


@checked
def sensor_width_mm(make: str, model: str) -> float | None:
    """Width of a camera's sensor in mm; None if it is not in the table."""
    return SENSOR_WIDTH_MM.get(camera_key(make, model))
