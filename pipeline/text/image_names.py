"""Names of images, as tables and files of all kinds have them."""

from pathlib import Path


def image_name(text: str) -> str:
    """An image's name: its file's name without folder, without a picture's ending, and without blanks at its ends,
    which no table keeps."""
    path = Path(text)
    endings = {".tif", ".tiff", ".jpg", ".jpeg", ".png"}
    return (path.stem if path.suffix.lower() in endings else path.name).strip()
