// Every kernel: a new header of pc/gpu with kernels joins here.
#pragma once

#include "pc/gpu/box_tree.hpp"
#include "pc/gpu/cell_table.hpp"
#include "pc/gpu/clusters.hpp"
#include "pc/gpu/deprojection.hpp"
#include "pc/gpu/farthest.hpp"
#include "pc/gpu/nearest.hpp"
#include "pc/gpu/planes.hpp"
#include "pc/gpu/radius.hpp"
#include "pc/gpu/registration.hpp"
#include "pc/gpu/unusual.hpp"
#include "pc/gpu/voxels.hpp"
