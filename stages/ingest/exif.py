"""What EXIF tells of a photo: its lens, its exposure, when and where it was taken."""

import math
from datetime import UTC, datetime
from typing import Any, NamedTuple

from PIL import ExifTags, Image

# Focal lengths over the longer side: 157 to 6 degrees through a pinhole, what COLMAP accepts. Others are rejected,
# from EXIF and from a fitted camera.
FOCAL_RANGE = (0.1, 10.0)
_ALTITUDES_M = (-500.0, 20_000.0)  # of shores and aircraft: beyond, a receiver has no fix


class GpsPosition(NamedTuple):
    """Where EXIF says that a photo was taken: degrees, north and east positive, and metres above the sea."""

    latitude: float | None = None
    longitude: float | None = None
    altitude_m: float | None = None


def read_exif(image: Image.Image, notes: list[str]) -> tuple[dict[str, Any], int]:
    """EXIF tags by name, and the orientation (1 where absent or invalid)."""
    try:
        exif = image.getexif()
        tags = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
    except Exception:  # Pillow raises what it likes of damaged tags; the pixels are good
        notes.append("its EXIF cannot be read")
        return {}, 1
    named = {ExifTags.TAGS.get(tag, str(tag)): value for tag, value in tags.items()}
    named |= {ExifTags.GPSTAGS.get(tag, str(tag)): value for tag, value in gps.items()}
    orientation = named.get("Orientation")
    return named, orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1


def focal_from_exif(tags: dict[str, Any], width: int, height: int) -> tuple[float | None, str | None]:
    """Focal length in pixels of an image of this size from EXIF, and the tag it came from; None if not told.

    The 35 mm equivalent is by the diagonal, as CIPA DCG-001 defines it and COLMAP reads it:
    f_px = f_35 · diagonal_px / 43.27. Otherwise FocalLength with the focal plane resolution, which counts pixels
    as the camera wrote them, so it is scaled to the present width (COLMAP does not). If the recorded pixel
    dimensions have another aspect the image was cropped and neither says anything. Digital zoom is in the 35 mm
    equivalent, as phones write it, and not in FocalLength.
    """
    longer, shorter = max(width, height), min(width, height)
    recorded = positive(tags.get("ExifImageWidth")), positive(tags.get("ExifImageHeight"))
    camera_longer = longer
    if recorded[0] and recorded[1]:
        camera_longer = max(recorded[0], recorded[1])
        if abs(min(recorded[0], recorded[1]) / camera_longer * longer / shorter - 1) > 0.02:
            return None, None
    focal, source = None, None
    focal_mm, resolution = positive(tags.get("FocalLength")), positive(tags.get("FocalPlaneXResolution"))
    unit_mm = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(tags.get("FocalPlaneResolutionUnit", 2))
    if focal_35 := positive(tags.get("FocalLengthIn35mmFilm")):
        focal, source = focal_35 / 43.27 * math.hypot(width, height), "FocalLengthIn35mmFilm"
    elif focal_mm and resolution and unit_mm:
        focal = focal_mm * digital_zoom(tags) * resolution / unit_mm * longer / camera_longer
        source = "FocalPlaneXResolution"
    if focal is None or not FOCAL_RANGE[0] <= focal / longer <= FOCAL_RANGE[1]:
        return None, None
    return focal, source


def digital_zoom(tags: dict[str, Any]) -> float:
    """By how much the photo was cut and enlarged (EXIF 2.32, tag 0xA404); 1 where that is missing, or 0 for none."""
    return positive(tags.get("DigitalZoomRatio")) or 1.0


def exposure_from_exif(tags: dict[str, Any]) -> float | None:
    """How many stops brighter a photo shows a scene than one of 1 s, f/1 and ISO 1 would: log2(t S / N²), of exposure
    time t, sensitivity S and f-number N (EXIF 2.32, tags 0x829A, 0x8827, 0x829D); None where one is missing or 0."""
    sensitivity = tags.get("ISOSpeedRatings")
    sensitivity = sensitivity[0] if isinstance(sensitivity, tuple | list) and sensitivity else sensitivity
    time, speed, stop = (positive(value) for value in (tags.get("ExposureTime"), sensitivity, tags.get("FNumber")))
    return math.log2(time) + math.log2(speed) - 2 * math.log2(stop) if time and speed and stop else None


def clock_from_exif(tags: dict[str, Any]) -> float | None:
    """When the photo was taken, in seconds since 1970 by the camera's own clock (EXIF 2.32, tags 0x9003 and 0x9291):
    it puts photos of one camera in order. None where it is missing, or a clock that was never set."""
    try:
        second = datetime.strptime(str(tags.get("DateTimeOriginal")).strip("\0 "), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    fraction = str(tags.get("SubsecTimeOriginal", "")).strip("\0 ")
    return second.replace(tzinfo=UTC).timestamp() + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)


def gps_from_exif(tags: dict[str, Any]) -> GpsPosition:
    """Latitude, longitude and altitude (EXIF 3.0, GPS tags 1 to 6); nothing where they are incomplete, out of range,
    or both 0, which is what a receiver writes without a fix."""
    latitude = _degrees(tags.get("GPSLatitude"), tags.get("GPSLatitudeRef"), "NS")
    longitude = _degrees(tags.get("GPSLongitude"), tags.get("GPSLongitudeRef"), "EW")
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return GpsPosition()
    if latitude == longitude == 0:
        return GpsPosition()
    altitude = _number(tags.get("GPSAltitude"))
    below_sea = tags.get("GPSAltitudeRef") in (1, b"\x01", 3, b"\x03")
    if altitude is not None:
        altitude = -altitude if below_sea else altitude
        altitude = altitude if _ALTITUDES_M[0] <= altitude <= _ALTITUDES_M[1] else None
    return GpsPosition(latitude, longitude, altitude)


def _degrees(value: Any, direction: Any, positive_negative: str) -> float | None:
    """(degrees, minutes, seconds) and a letter as signed degrees. Seconds may be unreadable, as 0/0 is, where the
    minutes have a fraction, which stands for them: without one up to a minute, 1.9 km, would be missing."""
    parts = [_number(part) for part in value] if isinstance(value, tuple | list) else []
    sign = {positive_negative[0]: 1, positive_negative[1]: -1}.get(str(direction).strip("\0 ").upper())
    if len(parts) != 3 or sign is None:
        return None
    degrees, minutes, seconds = parts
    if seconds is None and minutes is not None and not minutes.is_integer():
        seconds = 0.0
    if degrees is None or minutes is None or seconds is None:
        return None
    return sign * (degrees + minutes / 60 + seconds / 3600)


def _number(value: Any) -> float | None:
    """``value`` as a finite float; None for anything else that EXIF may hold."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None
