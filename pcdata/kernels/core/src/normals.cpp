// Surface normals from the covariance of the nearest points within a radius.
//
// Source: Hoppe et al., Surface reconstruction from unorganized points, 1992.
#include "pc/eigen.hpp"
#include "pc/search.hpp"

namespace pc {
namespace {

// The search finds only the k-th distance. A second look at its candidates sums the moments of the nearer ones in all
// lanes at once, which costs less than carrying sixteen lists of who they are; those at exactly the k-th distance are
// noted and enter by row until there are k.
class WriteNormals {
 public:
  WriteNormals(int64_t k, float* normals) : k_(k), normals_(normals) {}

  template <class Search, class Nearest>
  void operator()(const Search& search, const QueryGroup& group, const Nearest& nearest, const uint32_t* row) {
    const Floats kth = nearest.bound();
    LaneMoments sums;
    for (auto& tied : tied_) tied.clear();
    const Doubles query_x = widen(group.x), query_y = widen(group.y), query_z = widen(group.z);
    search.replay(group, kth, [&](const Floats& x, const Floats& y, const Floats& z, auto&& row_of) {
      const Floats squared = squared_length(x - group.x, y - group.y, z - group.z);
      const LaneMask reached = less_equal(squared, kth) & group.active;
      if (reached == 0) return;
      const LaneMask nearer = less(squared, kth);
      const Doubles dx = widen(x) - query_x, dy = widen(y) - query_y, dz = widen(z) - query_z;
      sums.add(reached & nearer, dx, dy, dz);
      if (const LaneMask tied = reached & ~nearer) note_ties(tied, dx, dy, dz, row_of);
    });
    write(sums, group.active, row);
  }

 private:
  struct LaneMoments {
    Doubles count{0.0}, x{0.0}, y{0.0}, z{0.0}, xx{0.0}, xy{0.0}, xz{0.0}, yy{0.0}, yz{0.0}, zz{0.0};

    void add(LaneMask mask, const Doubles& all_dx, const Doubles& all_dy, const Doubles& all_dz) {
      const Doubles dx = keep(mask, all_dx), dy = keep(mask, all_dy), dz = keep(mask, all_dz);
      count = count + keep(mask, Doubles(1.0));
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
  };
  static constexpr int kSums = sizeof(LaneMoments) / sizeof(Doubles);

  struct Tied {
    uint32_t row;
    double dx, dy, dz;
  };

  template <class RowOf>
  void note_ties(LaneMask lanes, const Doubles& dx, const Doubles& dy, const Doubles& dz, RowOf&& row_of) {
    alignas(64) double x[kQueries], y[kQueries], z[kQueries];
    dx.store(x);
    dy.store(y);
    dz.store(z);
    for (; lanes != 0; lanes &= lanes - 1) {
      const int lane = __builtin_ctz(lanes);
      tied_[lane].push_back({row_of(lane), x[lane], y[lane], z[lane]});
    }
  }

  void add_ties(int lane, Moments& sums) {
    auto& tied = tied_[lane];
    const int64_t wanted = k_ - static_cast<int64_t>(sums.count);
    if (static_cast<int64_t>(tied.size()) > wanted) {
      std::sort(tied.begin(), tied.end(), [](const Tied& a, const Tied& b) { return a.row < b.row; });
      tied.resize(static_cast<size_t>(wanted));
    }
    for (const Tied& t : tied) {
      sums.count += 1;
      sums.x += t.dx;
      sums.y += t.dy;
      sums.z += t.dz;
      sums.square.xx += t.dx * t.dx;
      sums.square.xy += t.dx * t.dy;
      sums.square.xz += t.dx * t.dz;
      sums.square.yy += t.dy * t.dy;
      sums.square.yz += t.dy * t.dz;
      sums.square.zz += t.dz * t.dz;
    }
  }

  void write(const LaneMoments& lanes, LaneMask active, const uint32_t* row) {
    alignas(64) double sum[kSums][kQueries], normal[3][kQueries];
    std::memcpy(sum, &lanes, sizeof(sum));
    for (LaneMask left = active; left != 0; left &= left - 1) {
      const int i = __builtin_ctz(left);
      Moments m = at(sum, i);
      add_ties(i, m);
      const double with_ties[kSums] = {m.count,     m.x,         m.y,         m.z,         m.square.xx,
                                       m.square.xy, m.square.xz, m.square.yy, m.square.yz, m.square.zz};
      for (int s = 0; s < kSums; ++s) sum[s][i] = with_ties[s];
    }
    for (int i = 0; i < kQueries; ++i) {
      const Vector3 n = normal_of(at(sum, i));
      normal[0][i] = n.x;
      normal[1][i] = n.y;
      normal[2][i] = n.z;
    }
    for (LaneMask left = active; left != 0; left &= left - 1) {
      const int i = __builtin_ctz(left);
      for (int axis = 0; axis < 3; ++axis) normals_[3 * int64_t{row[i]} + axis] = static_cast<float>(normal[axis][i]);
    }
  }

  static Moments at(const double (&sum)[kSums][kQueries], int i) {
    return {sum[0][i], sum[1][i], sum[2][i], sum[3][i], {sum[4][i], sum[5][i], sum[6][i], sum[7][i], sum[8][i], sum[9][i]}};
  }

  int64_t k_;
  float* normals_;  // (N, 3)
  std::vector<Tied> tied_[kQueries];
};

template <class Nearest>
void estimate(const pc_context& context, const Clouds& clouds, const Grid* grid, int64_t k, float limit,
              float* normals) {
  const WriteNormals task(k, normals);
  BatchSearch<Nearest, WriteNormals>(context, k, limit, task).run(clouds, grid);
}

}  // namespace
}  // namespace pc

// normals (N, 3) float; neighbours have d2 <= limit; pixel null: no grid.
PC_EXPORT int32_t pc_normals(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                             int64_t max_neighbors, double limit, const int64_t* pixel, int64_t width,
                             const double* camera, float* normals) {
  using namespace pc;
  return guarded([&] {
    const Grid grid{pixel, width, camera};
    const auto run = max_neighbors <= NearestDistances::kMax ? estimate<NearestDistances> : estimate<NearestMany>;
    run(*context, {points, ptr, num_clouds}, pixel == nullptr ? nullptr : &grid, max_neighbors,
        static_cast<float>(limit), normals);
  });
}
