"""Reading what `Fields` writes."""

import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import pytest

h5py = pytest.importorskip("h5py")


def read_xdmf(path):
    """Times, points, cells and one dict of fields per time; follows the XDMF file's references."""
    root = ElementTree.parse(path).getroot()
    grids = root.findall("./Domain/Grid/Grid")
    assert root.find("./Domain/Grid").get("CollectionType") == "Temporal"

    def data(element):
        item = element.find("DataItem")
        name, dataset = item.text.split(":")
        with h5py.File(path.parent / name, "r") as file:
            values = file[dataset][()]
        assert tuple(map(int, item.get("Dimensions").split())) == values.shape
        return values

    return SimpleNamespace(
        times=[float(g.find("Time").get("Value")) for g in grids],
        points=data(grids[0].find("Geometry")),
        cells=data(grids[0].find("Topology")),
        kind=grids[0].find("Topology").get("TopologyType"),
        fields=[{a.get("Name"): data(a) for a in g.findall("Attribute")} for g in grids],
    )
