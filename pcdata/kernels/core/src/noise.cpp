// Points that are moved and jittered, and rows chosen at random.
#include "pc/math/affine.hpp"
#include "pc/noise/normal.hpp"
#include "pc/rows/runs.hpp"
#include "pc/threads.hpp"

namespace pc::noise {
namespace {

constexpr int kBlock = 2 * kPairs / 3;  // points that are worked on at once: 64
constexpr int64_t kPointsPerPiece = 64 * kBlock;

// Points of a block, axis by axis: so no step has to shuffle them.
struct Block {
  float axis[3][kBlock];

  // A whole block has a loop of its own: with a fixed count it becomes vector code.
  void load(const float* points, int64_t count) {
    if (count == kBlock) return load_rows(points, std::integral_constant<int, kBlock>());
    std::memset(axis, 0, sizeof axis);
    load_rows(points, count);
  }
  void store(float* points, int64_t count) const {
    if (count == kBlock) return store_rows(points, std::integral_constant<int, kBlock>());
    store_rows(points, count);
  }
  // Write the rows that are kept one after another; returns how many.
  int64_t store_kept(float* points, const uint8_t* kept, int64_t count) const {
    float together[3 * kBlock];
    store_rows(together, std::integral_constant<int, kBlock>());
    int32_t packed[3 * kBlock + kLanes];
    const int64_t written = rows::pack_rows<3>(reinterpret_cast<const char*>(together), kept, count, packed);
    std::memcpy(points, packed, static_cast<size_t>(3 * written) * sizeof(float));
    return written;
  }
  void move(const double* matrix) {
    const math::Affine affine(matrix);
    for (int i = 0; i < kBlock; ++i) {
      const math::Point p = affine({axis[0][i], axis[1][i], axis[2][i]});
      axis[0][i] = p.x;
      axis[1][i] = p.y;
      axis[2][i] = p.z;
    }
  }
  // Of the words of a block, each axis has a third; both halves of the block have one number of each.
  void jitter(uint64_t seed, int64_t number, float sigma, float clip) {
    float pairs[2][kPairs];
    normal_pairs(seed, static_cast<uint64_t>(number) * kPairs, pairs[0], pairs[1]);
    constexpr int kHalf = kBlock / 2;
    for (int a = 0; a < 3; ++a)
      for (int half = 0; half < 2; ++half)
        for (int i = 0; i < kHalf; ++i) {
          float change = pairs[half][a * kHalf + i] * sigma;
          change = change > clip ? clip : change;
          change = change < -clip ? -clip : change;
          axis[a][half * kHalf + i] += change;
        }
  }

 private:
  template <class Count>
  void load_rows(const float* points, Count count) {
    for (int64_t i = 0; i < count; ++i)
      for (int a = 0; a < 3; ++a) axis[a][i] = points[3 * i + a];
  }
  template <class Count>
  void store_rows(float* points, Count count) const {
    for (int64_t i = 0; i < count; ++i)
      for (int a = 0; a < 3; ++a) points[3 * i + a] = axis[a][i];
  }
};

// Steps that points are taken through, as pc_move_points has them.
struct Steps {
  int64_t count, num_clouds;
  const int64_t* is_noise;
  const double* matrices;
  const int64_t* seeds;
  const double *sigma, *clip;

  // Take a block of a cloud through all.
  void run(Block& block, int64_t cloud, int64_t number) const {
    for (int64_t step = 0; step < count; ++step) {
      const int64_t at = step * num_clouds + cloud;
      if (is_noise[step])
        block.jitter(static_cast<uint64_t>(seeds[at]), number, static_cast<float>(sigma[step]),
                     static_cast<float>(clip[step]));
      else
        block.move(matrices + 16 * at);
    }
  }
};

// mask (count,) = 1 at so many rows that a seed chooses, else 0.
void choose_rows(int64_t count, int64_t wanted, uint64_t seed, uint8_t* mask) {
  const int64_t few = std::min(wanted, count - wanted);
  const uint8_t chosen = few == wanted;
  std::memset(mask, 1 - chosen, static_cast<size_t>(count));
  int64_t left = few;
  for (uint64_t number = 0; left > 0; ++number) {
    const uint64_t mixed = math::random_word(seed, number);
    for (const uint64_t half : {mixed & 0xFFFFFFFFu, mixed >> 32}) {
      uint8_t& place = mask[(half * static_cast<uint64_t>(count)) >> 32];
      if (left > 0 && place != chosen) {
        place = chosen;
        --left;
      }
    }
  }
}

}  // namespace
}  // namespace pc::noise

PC_EXPORT int32_t pc_move_points(const pc_context* context, const float* points, const int64_t* sources,
                                 const int64_t* ptr, int64_t num_clouds, int64_t num_steps, const int64_t* is_noise,
                                 const double* matrices, const int64_t* seeds, const double* sigma, const double* clip,
                                 const uint8_t* kept, const int64_t* kept_ptr, float* moved) {
  using namespace pc;
  using namespace pc::noise;
  return guarded([&] {
    const Steps steps{num_steps, num_clouds, is_noise, matrices, seeds, sigma, clip};
    // The rows from `row` on, which are of a cloud.
    const auto rows_at = [&](int64_t cloud, int64_t row) {
      if (sources == nullptr) return points + 3 * row;
      return reinterpret_cast<const float*>(sources[cloud]) + 3 * (row - ptr[cloud]);
    };
    if (kept != nullptr) {
      // In the same memory a cloud is written where those before it were.
      const pc_context alone{1, context->poll};
      parallel_for(sources == nullptr && points == moved ? alone : *context, num_clouds, 1,
                   [&](int64_t first, int64_t last, int64_t) {
                     for (int64_t cloud = first; cloud < last; ++cloud) {
                       float* to = moved + 3 * kept_ptr[cloud];
                       for (int64_t row = ptr[cloud], number = 0; row < ptr[cloud + 1]; row += kBlock, ++number) {
                         const int64_t count = std::min<int64_t>(kBlock, ptr[cloud + 1] - row);
                         Block block;
                         block.load(rows_at(cloud, row), count);
                         steps.run(block, cloud, number);
                         to += 3 * block.store_kept(to, kept + row, count);
                       }
                     }
                   });
      return;
    }
    // A piece is a part of the rows of all clouds; blocks begin at a cloud's first row, so that noise keeps its pairs.
    parallel_for(*context, ptr[num_clouds], kPointsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      int64_t cloud = std::upper_bound(ptr, ptr + num_clouds + 1, first) - ptr - 1;
      for (; cloud < num_clouds && ptr[cloud] < last; ++cloud) {
        const int64_t begin = ptr[cloud], end = ptr[cloud + 1];
        // Blocks that begin in this piece.
        int64_t row = first <= begin ? begin : begin + (first - begin + kBlock - 1) / kBlock * kBlock;
        for (; row < std::min(last, end); row += kBlock) {
          const int64_t count = std::min<int64_t>(kBlock, end - row);
          Block block;
          block.load(rows_at(cloud, row), count);
          steps.run(block, cloud, (row - begin) / kBlock);
          block.store(moved + 3 * row, count);
        }
      }
    });
  });
}

PC_EXPORT int32_t pc_dropped_rows(const pc_context* context, const int64_t* keys, const int64_t* ptr,
                                  int64_t num_clouds, double low, double high, uint8_t* mask, int64_t* kept_ptr) {
  using namespace pc;
  using namespace pc::noise;
  (void)context;
  return guarded([&] {
    kept_ptr[0] = 0;
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
      const int64_t count = ptr[cloud + 1] - ptr[cloud];
      const auto key = static_cast<uint64_t>(keys[cloud]);
      const double part = low + (high - low) * (static_cast<double>(math::random_word(key, 0) >> 11) * 0x1p-53);
      const auto dropped = static_cast<int64_t>(std::nearbyint(static_cast<double>(count) * part));
      const int64_t kept = std::max(count - dropped, std::min<int64_t>(count, 1));
      choose_rows(count, kept, math::random_word(key, 1) >> 2, mask + ptr[cloud]);
      kept_ptr[cloud + 1] = kept_ptr[cloud] + kept;
    }
  });
}
