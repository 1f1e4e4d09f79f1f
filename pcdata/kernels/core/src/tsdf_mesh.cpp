// Triangles between the zero crossings of a truncated signed distance field: those of
// pcdata/functional/tsdf/marching.py, in the same order.
//
// Eight words of 64 bits hold one property of a block's voxels, one word per z: the corners of all cubes of a slab are
// words shifted by a voxel, a line or a slab.
#include "pc/simd.hpp"
#include "pc/threads.hpp"
#include "pc/tsdf/walk.hpp"

namespace pc::tsdf {
namespace {

constexpr int64_t kBlocksAtATime = 64;   // blocks
constexpr int64_t kEdges = 3 * kVoxels;  // of a block

// -- what the cubes look up ---------------------------------------------------------------------------------------

struct BlockSigns {
  uint64_t inside[kEdge], seen[kEdge];  // below zero; of a weight that is high enough
};

// The vertices on the edges of a block: a bit each, and the row of the first one of every slab.
struct BlockEdges {
  uint64_t along[kEdge][3];
  int64_t first[kEdge];

  bool has(int voxel, int axis) const { return along[voxel / kSlab][axis] >> voxel % kSlab & 1; }
  // Vertices are sorted by voxel, then axis.
  int64_t row(int voxel, int axis) const {
    const uint64_t* words = along[voxel / kSlab];
    const uint64_t before = (uint64_t{1} << voxel % kSlab) - 1, here = uint64_t{1} << voxel % kSlab;
    int64_t row = first[voxel / kSlab];
    for (int a = 0; a < 3; ++a) row += __builtin_popcountll(words[a] & (a < axis ? before | here : before));
    return row;
  }
};

// An edge of the cube: 3 * the corner at which it starts + the axis that it runs along.
constexpr int kCubeEdges = 24;

struct Mesh {
  SortedBlocks blocks;
  const BlockSigns* signs;  // (count,)
  const BlockEdges* edges;  // (count,)
  const int64_t* table;     // (257,) the first triangle of every case of the cube
  const int64_t* corners;   // (K, 3) per triangle the edges of the cube on which its corners lie
  uint32_t cut[256] = {};   // a bit per edge of the cube: those that a case has corners on

  Mesh(const SortedBlocks& sorted, const int64_t* all_signs, const int64_t* all_edges, const int64_t* first,
       const int64_t* edges_of_cube)
      : blocks(sorted),
        signs(reinterpret_cast<const BlockSigns*>(all_signs)),
        edges(reinterpret_cast<const BlockEdges*>(all_edges)),
        table(first),
        corners(edges_of_cube) {
    for (int number = 0; number < 256; ++number)
      for (int64_t c = 3 * table[number]; c < 3 * table[number + 1]; ++c) cut[number] |= uint32_t{1} << corners[c];
  }
};

void find_signs(const pc_context& context, const SortedBlocks& blocks, const VoxelPlanes& planes, int16_t bound,
                BlockSigns* signs) {
  parallel_for(context, blocks.count, kBlocksAtATime, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t i = begin; i < end; ++i) {
      const int16_t *tsdf = planes.tsdf.block(blocks.rows[i]), *weight = planes.weight.block(blocks.rows[i]);
      for (int z = 0; z < kEdge; ++z) {
        int8_t below[kSlab], enough[kSlab];
        for (int v = 0; v < kSlab; ++v) {
          below[v] = static_cast<int8_t>(tsdf[kSlab * z + v] < 0 ? -1 : 0);
          enough[v] = static_cast<int8_t>(weight[kSlab * z + v] > bound ? -1 : 0);
        }
        signs[i].inside[z] = signs_of(below);
        signs[i].seen[z] = signs_of(enough);
      }
    }
  });
}

void index_edges(const pc_context& context, int64_t count, const int64_t* edge, int64_t num_edges, BlockEdges* edges) {
  parallel_for(context, count, kBlocksAtATime, [&](int64_t begin, int64_t end, int64_t) {
    int64_t row = std::lower_bound(edge, edge + num_edges, begin * kEdges) - edge;
    for (int64_t i = begin; i < end; ++i) {
      BlockEdges block{};
      for (int z = 0; z < kEdge; ++z) {
        block.first[z] = row;
        const int64_t slab = kEdges * i + 3 * kSlab * z;
        for (; row < num_edges && edge[row] < slab + 3 * kSlab; ++row) {
          const auto inner = static_cast<uint32_t>(edge[row] - slab);
          block.along[z][inner % 3] |= uint64_t{1} << inner / 3;
        }
      }
      edges[i] = block;
    }
  });
}

// -- the cubes of a block -----------------------------------------------------------------------------------------

// A block and those after it: bit 0 of a number is a step along x, bit 1 along y, bit 2 along z; -1 where none is.
using Octet = int64_t[8];

class OctetWalk {
 public:
  OctetWalk(const SortedBlocks& blocks, int64_t first) {
    for (int c = 0; c < 4; ++c) columns_.emplace_back(blocks, first, c & 1, c >> 1);
  }
  void look(int64_t key, Octet& places) {
    for (int c = 0; c < 4; ++c) {
      int64_t found[3];
      columns_[static_cast<size_t>(c)].look(key, found);
      places[c] = found[1];
      places[c + 4] = found[2];
    }
  }

 private:
  std::vector<Column> columns_;
};

// One property of the eight corners of a slab's cubes, a bit per cube.
struct CornerBits {
  uint64_t of[8];

  // `word(place, z)` is the word of one block and slab.
  template <class Word>
  CornerBits(const Octet& places, int z, const Word& word) {
    for (int dz = 0; dz < 2; ++dz) {
      uint64_t here[4];  // of this block, the next along x, along y, along both
      for (int c = 0; c < 4; ++c) {
        const int64_t place = places[z + dz < kEdge ? c : c + 4];
        here[c] = place < 0 ? 0 : word(place, (z + dz) % kEdge);
      }
      for (int dx = 0; dx < 2; ++dx) {
        const uint64_t near = dx == 0 ? here[0] : a_voxel_on(here[0], here[1]);
        const uint64_t far = dx == 0 ? here[2] : a_voxel_on(here[2], here[3]);
        of[dx + 4 * dz] = near;
        of[dx + 2 + 4 * dz] = near >> kEdge | far << (kSlab - kEdge);
      }
    }
  }
  uint64_t all() const {
    uint64_t bits = ~uint64_t{0};
    for (const uint64_t word : of) bits &= word;
    return bits;
  }
  uint64_t any() const {
    uint64_t bits = 0;
    for (const uint64_t word : of) bits |= word;
    return bits;
  }
  int cube(int number) const {
    int corners = 0;
    for (int c = 0; c < 8; ++c) corners |= static_cast<int>(of[c] >> number & 1) << c;
    return corners;
  }

 private:
  static uint64_t a_voxel_on(uint64_t word, uint64_t next) {
    constexpr uint64_t first_of_lines = 0x0101010101010101;
    return (word >> 1 & ~(first_of_lines << 7)) | (next & first_of_lines) << 7;
  }
};

// The cubes of one slab that hold triangles.
struct SlabCubes {
  CornerBits inside;
  uint64_t cubes;    // those with corners on both sides, all seen
  uint64_t lacking;  // those with a cut edge that has no vertex

  SlabCubes(const Mesh& mesh, const Octet& places, int z)
      : inside(places, z, [&](int64_t place, int at) { return mesh.signs[place].inside[at]; }),
        cubes(inside.any() & ~inside.all()),
        lacking(0) {
    if (cubes == 0) return;
    cubes &= CornerBits(places, z, [&](int64_t place, int at) { return mesh.signs[place].seen[at]; }).all();
    if (cubes == 0) return;
    for (int axis = 0; axis < 3; ++axis) {
      const CornerBits has(places, z, [&](int64_t place, int at) { return mesh.edges[place].along[at][axis]; });
      for (int c = 0; c < 8; ++c)
        if ((c >> axis & 1) == 0) lacking |= (inside.of[c] ^ inside.of[c | 1 << axis]) & ~has.of[c];
    }
  }
};

// Rows of the vertices on the cut edges of one cube; -1 where there is none.
struct CubeRows {
  int64_t of[kCubeEdges];

  void find(const Mesh& mesh, const Octet& places, int cube, uint32_t cut, bool lacks) {
    for (; cut != 0; cut &= cut - 1) {
      const int edge = __builtin_ctz(cut), axis = edge % 3, corner = edge / 3;
      const int x = (cube & 7) + (corner & 1), y = (cube >> 3 & 7) + (corner >> 1 & 1), z = (cube >> 6) + (corner >> 2);
      const int voxel = (z & 7) * kSlab + (y & 7) * kEdge + (x & 7);
      const BlockEdges& edges = mesh.edges[places[x >> 3 | y >> 3 << 1 | z >> 3 << 2]];
      of[edge] = lacks && !edges.has(voxel, axis) ? -1 : edges.row(voxel, axis);
    }
  }
};

int64_t count_triangles(const Mesh& mesh, const Octet& places) {
  int64_t total = 0;
  CubeRows rows;
  for (int z = 0; z < kEdge; ++z) {
    const SlabCubes slab(mesh, places, z);
    for (uint64_t left = slab.cubes; left != 0; left &= left - 1) {
      const int number = __builtin_ctzll(left), sides = slab.inside.cube(number);
      total += mesh.table[sides + 1] - mesh.table[sides];
      if ((slab.lacking >> number & 1) == 0) continue;
      rows.find(mesh, places, kSlab * z + number, mesh.cut[sides], true);
      for (int64_t t = mesh.table[sides]; t < mesh.table[sides + 1]; ++t) {
        const int64_t* at = mesh.corners + 3 * t;
        total -= std::min({rows.of[at[0]], rows.of[at[1]], rows.of[at[2]]}) < 0;
      }
    }
  }
  return total;
}

void write_triangles(const Mesh& mesh, const Octet& places, int64_t* to, uint8_t* used) {
  CubeRows rows;
  for (int z = 0; z < kEdge; ++z) {
    const SlabCubes slab(mesh, places, z);
    for (uint64_t left = slab.cubes; left != 0; left &= left - 1) {
      const int number = __builtin_ctzll(left), sides = slab.inside.cube(number);
      rows.find(mesh, places, kSlab * z + number, mesh.cut[sides], slab.lacking >> number & 1);
      for (int64_t t = mesh.table[sides]; t < mesh.table[sides + 1]; ++t) {
        const int64_t* at = mesh.corners + 3 * t;
        if (std::min({rows.of[at[0]], rows.of[at[1]], rows.of[at[2]]}) < 0) continue;
        for (int c = 0; c < 3; ++c) {
          *to++ = rows.of[at[c]];
          __atomic_store_n(used + rows.of[at[c]], uint8_t{1}, __ATOMIC_RELAXED);  // threads may meet at a border
        }
      }
    }
  }
}

template <class Body>
void each_block(const pc_context& context, const Mesh& mesh, const Body& body) {
  parallel_for(context, mesh.blocks.count, kBlocksAtATime, [&](int64_t begin, int64_t end, int64_t) {
    OctetWalk walk(mesh.blocks, begin);
    for (int64_t i = begin; i < end; ++i) {
      Octet places;
      walk.look(mesh.blocks.keys[i], places);
      body(i, places);
    }
  });
}

}  // namespace
}  // namespace pc::tsdf

PC_EXPORT int32_t pc_tsdf_index_mesh(const pc_context* context, const int64_t* keys, const int64_t* rows, int64_t count,
                                     const int64_t* const* planes, int64_t bound, const int64_t* edge,
                                     int64_t num_edges, int64_t* signs, int64_t* edges) {
  using namespace pc;
  using namespace pc::tsdf;
  static_assert(sizeof(BlockSigns) == 16 * 8 && sizeof(BlockEdges) == 32 * 8);
  return guarded([&] {
    find_signs(*context, {keys, rows, count}, VoxelPlanes(planes), static_cast<int16_t>(bound),
               reinterpret_cast<BlockSigns*>(signs));
    index_edges(*context, count, edge, num_edges, reinterpret_cast<BlockEdges*>(edges));
  });
}

PC_EXPORT int32_t pc_tsdf_count_triangles(const pc_context* context, const int64_t* keys, int64_t count,
                                          const int64_t* signs, const int64_t* edges, const int64_t* table,
                                          const int64_t* corners, int64_t* counts) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    const Mesh mesh({keys, nullptr, count}, signs, edges, table, corners);
    each_block(*context, mesh,
               [&](int64_t block, const Octet& places) { counts[block] = count_triangles(mesh, places); });
  });
}

PC_EXPORT int32_t pc_tsdf_write_triangles(const pc_context* context, const int64_t* keys, int64_t count,
                                          const int64_t* signs, const int64_t* edges, const int64_t* table,
                                          const int64_t* corners, const int64_t* starts, int64_t* triangles,
                                          uint8_t* used) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    const Mesh mesh({keys, nullptr, count}, signs, edges, table, corners);
    each_block(*context, mesh, [&](int64_t block, const Octet& places) {
      if (starts[block] < starts[block + 1]) write_triangles(mesh, places, triangles + 3 * starts[block], used);
    });
  });
}

PC_EXPORT int32_t pc_tsdf_renumber(const pc_context* context, int64_t* entries, int64_t count, const int64_t* number) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    parallel_for(*context, count, int64_t{1} << 16, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) entries[i] = number[entries[i]];
    });
  });
}
