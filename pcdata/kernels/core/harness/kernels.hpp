// Every kernel: a new header of pc/gpu with kernels joins here.
#pragma once

#include "pc/gpu/cell_table.hpp"
#include "pc/gpu/radius.hpp"
