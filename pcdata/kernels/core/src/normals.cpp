// Surface normals from the covariance of the nearest points within a radius.
//
// Source: Hoppe et al., Surface reconstruction from unorganized points, 1992.
#include "pc/math/normal.hpp"
#include "pc/neighbors/batch_search.hpp"
#include "pc/neighbors/nearest_keys.hpp"

namespace pc::neighbors {
namespace {

// The search finds only the k-th distance. A second look at its candidates sums the moments of those that are no
// farther in all lanes at once, which costs less than carrying sixteen lists of who they are. Where several lie at
// exactly the k-th distance that may be more than k: the highest rows among these are taken out again.
class WriteNormals {
 public:
  WriteNormals(int64_t k, float* normals) : k_(k), normals_(normals) {}

  template <class Search, class Nearest>
  void operator()(const Search& search, const QueryGroup& group, const Nearest& nearest, const uint32_t* row) {
    const FloatPack kth = nearest.bound();
    const DoublePack query_x = widen(group.x), query_y = widen(group.y), query_z = widen(group.z);
    Sums sums;
    tied_.clear();
    search.replay(group, kth, [&](const FloatPack& x, const FloatPack& y, const FloatPack& z, uint32_t id) {
      const FloatPack squared = squared_length(x - group.x, y - group.y, z - group.z);
      const PackMask reached = less_equal(squared, kth) & group.active;
      if (reached == 0) return;
      sums.add(reached, widen(x) - query_x, widen(y) - query_y, widen(z) - query_z);
      if (const PackMask tied = reached & ~less(squared, kth)) tied_.push_back({x, y, z, tied, id});
    });
    alignas(64) double sum[kSums][kQueries];
    sums.store(sum);
    for (PackMask left = group.active; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      if (sum[0][lane] > static_cast<double>(k_)) take_out_surplus(search, group, lane, sum);
    }
    write(sum, group.active, row);
  }

 private:
  // Count, then first and second moments.
  static constexpr int kSums = 10;

  struct Sums {
    FloatPack count{0.0f};  // whole and small: exact
    DoublePack x{0.0}, y{0.0}, z{0.0}, xx{0.0}, xy{0.0}, xz{0.0}, yy{0.0}, yz{0.0}, zz{0.0};

    void add(PackMask mask, const DoublePack& all_dx, const DoublePack& all_dy, const DoublePack& all_dz) {
      const DoublePack dx = keep(mask, all_dx), dy = keep(mask, all_dy), dz = keep(mask, all_dz);
      count = count + keep(mask, FloatPack(1.0f));
      x = x + dx;
      y = y + dy;
      z = z + dz;
      xx = xx + dx * dx;
      xy = xy + dx * dy;
      xz = xz + dx * dz;
      yy = yy + dy * dy;
      yz = yz + dy * dz;
      zz = zz + dz * dz;
    }
    void store(double (&to)[kSums][kQueries]) const {
      const DoublePack all[kSums] = {widen(count), x, y, z, xx, xy, xz, yy, yz, zz};
      for (int s = 0; s < kSums; ++s) all[s].store(to[s]);
    }
  };

  // A candidate at the k-th distance in some lanes.
  struct Tied {
    FloatPack x, y, z;
    PackMask lanes;
    uint32_t id;
  };

  template <class Search>
  void take_out_surplus(const Search& search, const QueryGroup& group, int lane, double (&sum)[kSums][kQueries]) {
    order_.clear();
    for (const Tied& tied : tied_)
      if (tied.lanes >> lane & 1) order_.push_back({search.row_in_lane(tied.id, lane), &tied});
    const auto surplus = static_cast<ptrdiff_t>(sum[0][lane]) - static_cast<ptrdiff_t>(k_);
    std::nth_element(order_.begin(), order_.end() - surplus, order_.end());
    for (auto out = order_.end() - surplus; out != order_.end(); ++out) {
      const Tied& tied = *out->second;
      const double x = double{tied.x[lane]} - double{group.x[lane]}, y = double{tied.y[lane]} - double{group.y[lane]},
                   z = double{tied.z[lane]} - double{group.z[lane]};
      const double term[kSums] = {1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z};
      for (int s = 0; s < kSums; ++s) sum[s][lane] -= term[s];
    }
  }

  void write(const double (&sum)[kSums][kQueries], PackMask active, const uint32_t* row) {
    alignas(64) double normal[3][kQueries];
    for (int i = 0; i < kQueries; ++i) {
      const math::Vector3 n = math::normal_of(at(sum, i));
      normal[0][i] = n.x;
      normal[1][i] = n.y;
      normal[2][i] = n.z;
    }
    for (PackMask left = active; left != 0; left &= left - 1) {
      const int i = __builtin_ctz(left);
      for (int axis = 0; axis < 3; ++axis) normals_[3 * int64_t{row[i]} + axis] = static_cast<float>(normal[axis][i]);
    }
  }

  static math::Moments at(const double (&sum)[kSums][kQueries], int i) {
    return {
        sum[0][i], sum[1][i], sum[2][i], sum[3][i], {sum[4][i], sum[5][i], sum[6][i], sum[7][i], sum[8][i], sum[9][i]}};
  }

  int64_t k_;
  float* normals_;  // (N, 3)
  std::vector<Tied> tied_;
  std::vector<std::pair<uint32_t, const Tied*>> order_;  // by row
};

template <class Nearest>
void estimate(const pc_context& context, const Clouds& clouds, const Grid* grid, int64_t k, float limit,
              float* normals) {
  const WriteNormals task(k, normals);
  BatchSearch<Nearest, WriteNormals>(context, k, limit, task).run(clouds, grid);
}

void turn_to_viewpoint(const pc_context& context, const float* points, const float* normals, int64_t count,
                       const float* viewpoint, bool one_for_all, float* facing) {
  parallel_for(context, count, 1 << 15, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t i = 3 * begin; i < 3 * end; i += 3) {
      const float *p = points + i, *n = normals + i, *v = one_for_all ? viewpoint : viewpoint + i;
      const double x = double{n[0]} * (double{v[0]} - double{p[0]}), y = double{n[1]} * (double{v[1]} - double{p[1]}),
                   z = double{n[2]} * (double{v[2]} - double{p[2]});
      const bool away = (x + y) + z < 0;
      for (int axis = 0; axis < 3; ++axis) facing[i + axis] = away ? -n[axis] : n[axis];
    }
  });
}

}  // namespace
}  // namespace pc::neighbors

PC_EXPORT int32_t pc_normals(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                             int64_t max_neighbors, double limit, const int64_t* pixel, int64_t width,
                             const double* camera, const float* viewpoint, int64_t one_for_all, float* normals) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    const Grid grid{pixel, width, camera};
    const auto run = max_neighbors <= NearestDistances::kMax ? estimate<NearestDistances> : estimate<NearestMany>;
    run(*context, {points, ptr, num_clouds}, pixel == nullptr ? nullptr : &grid, max_neighbors,
        static_cast<float>(limit), normals);
    if (viewpoint != nullptr)
      turn_to_viewpoint(*context, points, normals, ptr[num_clouds], viewpoint, one_for_all != 0, normals);
  });
}

PC_EXPORT int32_t pc_face_normals(const pc_context* context, const float* points, const float* normals, int64_t count,
                                  const float* viewpoint, int64_t one_for_all, float* facing) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] { turn_to_viewpoint(*context, points, normals, count, viewpoint, one_for_all != 0, facing); });
}
