"""All data sets by name."""

from __future__ import annotations

from octoreplay.errors import ConfigError, suggestion
from octoreplay.io.datasets.catalogue import (
    coped,
    cu_multi,
    graco,
    kimera_multi,
    kitti,
    m3ed,
    ntu_viral,
    refused,
    replica,
    s3e,
    scannet,
    tartanair,
    wildscenes,
)
from octoreplay.io.datasets.catalogue.data_set import DataSet

DATA_SETS: dict[str, DataSet] = {
    data_set.name: data_set
    for data_set in (
        kimera_multi.DATA_SET, cu_multi.DATA_SET, s3e.DATA_SET, graco.DATA_SET, ntu_viral.DATA_SET,
        kitti.DATA_SET, tartanair.DATA_SET, replica.DATA_SET, scannet.DATA_SET,
        wildscenes.DATA_SET, m3ed.DATA_SET,
        refused.SUBT_MRS, coped.DATA_SET,
    )
}  # fmt: skip


def data_set(name: str) -> DataSet:
    """Return a data set by its name. Raises ConfigError, which names the nearest one."""
    if name not in DATA_SETS:
        near = suggestion(name.lower(), tuple(DATA_SETS))
        raise ConfigError(f"data set '{name}' is not known{near}; --list shows all names")
    return DATA_SETS[name]
