// Every kernel: a new header of pc/gpu with kernels joins here.
#pragma once

#include "pc/gpu/box_tree.hpp"
#include "pc/gpu/cell_table.hpp"
#include "pc/gpu/clusters.hpp"
#include "pc/gpu/compaction.hpp"
#include "pc/gpu/deprojection.hpp"
#include "pc/gpu/depth_filters.hpp"
#include "pc/gpu/farthest.hpp"
#include "pc/gpu/holes.hpp"
#include "pc/gpu/nearest.hpp"
#include "pc/gpu/planes.hpp"
#include "pc/gpu/radius.hpp"
#include "pc/gpu/registration.hpp"
#include "pc/gpu/resampling.hpp"
#include "pc/gpu/unusual.hpp"
#include "pc/gpu/voxels.hpp"
