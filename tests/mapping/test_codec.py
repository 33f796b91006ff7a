from __future__ import annotations

import dataclasses
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from mapping.hand_octree import brick_code, cells_of, cube, octree_of
from octoreplay.errors import PacketError
from octoreplay.mapping import codec, kernels
from octoreplay.mapping.octree import SemanticOctree
