"""Makes the SVG file of a chart fit for an HTML page: unique ids, a title, and no global styles."""

import re
from xml.etree import ElementTree

NUMBER = re.compile(r"-?\d+\.\d{3,}")
REFERENCE = re.compile(r"url\(#([^)]+)\)")


def inline(svg: bytes, prefix: str, title: str) -> str:
    """The `<svg>` element as HTML; every id gets the prefix `prefix-`."""
    root = ElementTree.fromstring(svg)
    for element in root.iter():
        element.tag = _local(element.tag)
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in ("metadata", "style"):  # a style inside an SVG would apply to the whole page
                parent.remove(child)
        _hoist_style(parent)
    for element in root.iter():
        _clean(element, prefix)
    box = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": box, "role": "img", "aria-labelledby": f"{prefix}-title"})
    heading = ElementTree.Element("title", {"id": f"{prefix}-title"})
    heading.text = title
    root.insert(0, heading)
    return ElementTree.tostring(root, encoding="unicode")


def _clean(element: ElementTree.Element, prefix: str) -> None:
    """Remove namespaces and white space between tags, and round numbers to hundredths of a point."""
    for name, value in list(element.attrib.items()):
        del element.attrib[name]
        local = _local(name)
        if local == "id":
            value = f"{prefix}-{value}"
        elif local == "href":
            value = f"#{prefix}-{value.removeprefix('#')}"
        elif local in ("d", "x", "y", "transform"):
            value = NUMBER.sub(lambda found: f"{float(found[0]):.2f}", value)
        element.attrib[local] = REFERENCE.sub(rf"url(#{prefix}-\1)", value)
    if not (element.text or "").strip():
        element.text = None
    element.tail = None


def _hoist_style(group: ElementTree.Element) -> None:
    """Move a style that all marks of a group share to the group, so that it is written once."""
    styles = {child.get("style") for child in group}
    style = styles.pop() if len(styles) == 1 else None
    if style and len(group) > 1 and all(child.tag == "use" for child in group):
        for child in group:
            del child.attrib["style"]
        group.set("style", style)


def _local(name: str) -> str:
    return name.rpartition("}")[2]
