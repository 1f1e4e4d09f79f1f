"""XML that comes from elsewhere, read without what lets a small file grow without bound."""

from __future__ import annotations

from xml.etree import ElementTree

from pcdata.errors import CaptureError


def xml_root(where: str, text: str) -> ElementTree.Element:
    """Return the outermost element.

    Raises:
        CaptureError: it is no XML, or has a document type (entities may stand for gigabytes).
    """
    if "<!" in text.replace("<!--", ""):
        raise CaptureError(f"{where}: such a file has no document type and no entities; remove <!DOCTYPE ...>")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise CaptureError(f"{where}: is no XML: {str(error)[:200]}") from error
