// The plane of each cloud with the most points: drawn, counted, chosen, refined and turned in one call.
#include <tuple>

#include "pc/planes/best_of_all.hpp"
#include "pc/planes/clouds.hpp"
#include "pc/planes/hypotheses.hpp"
#include "pc/planes/tries.hpp"

namespace pc::planes {
namespace {

struct SearchRules {
  RefinementRules refinement;
  double distance, missed;  // log(1 - probability); 0: all planes are counted on all points
  int64_t bits;
};

// Finds the plane of one cloud.
class PlaneOfCloud {
 public:
  PlaneOfCloud(const pc_context& context, const float* points, int64_t count, const SearchRules& rules)
      : context_(context), points_(points), count_(count), rules_(rules) {}

  // `found` (3): of the hypotheses how many are planes and how many of those compete, where the best has too few points
  // near it; and how many it has, of those that are looked at.
  void find(const Draws& draws, const double* guess, const double* up, const double* upper, double* plane,
            uint8_t* near, int64_t* found) const {
    ScratchFrame scratch;
    const Runs runs = bound_runs(context_, points_, count_, scratch);
    const Hypotheses tried(points_, count_, draws, guess, upper, rules_.refinement, scratch);
    const Best best = rules_.missed == 0 ? best_of_all(tried, runs, scratch) : best_until_sure(tried);
    found[0] = found[1] = 0;
    found[2] = best.near;
    if (best.near < kFewest) {
      std::tie(found[0], found[1]) = tried.num_planes();
      std::fill_n(plane, 4, std::numeric_limits<double>::quiet_NaN());
      std::fill_n(near, count_, uint8_t{0});
      return;
    }
    std::copy_n(tried.plane(best.plane), 4, plane);
    Refinement(context_, runs, rules_.refinement, upper).run(plane, near, scratch);
    turn(plane, up);
  }

 private:
  static constexpr int64_t kFewest = 3;  // points
  static constexpr int kAllBits = 62;

  Best best_of_all(const Hypotheses& tried, const Runs& runs, ScratchFrame& scratch) const {
    parallel_for(context_, tried.count(), 256,
                 [&](int64_t begin, int64_t end, int64_t) { tried.make(begin, end - begin); });
    return BestOfAll(context_, runs, tried.rounded_planes(), tried.competes(), tried.count(),
                     static_cast<float>(rules_.distance))
        .find(scratch);
  }

  Best best_until_sure(const Hypotheses& tried) const {
    const Best best = best_until_sure(tried, rules_.bits);
    return best.near < kFewest ? best_until_sure(tried, kAllBits) : best;
  }

  Best best_until_sure(const Hypotheses& tried, int64_t bits) const {
    ScratchFrame scratch;
    const ScoredPoints some(points_, count_, bits, scratch);
    Best best;
    Tries(context_, some, {rules_.distance, rules_.missed, tried.num_guesses()})
        .run(
            tried.rounded_planes(), tried.competes(), tried.count(),
            [&](int64_t first, int64_t number) { tried.make(first, number); },
            [&](int64_t plane, int64_t near) { best = {plane, near}; });
    return best;
  }

  // Turn a normal along `up`, else toward an origin off the plane, else so that its largest component is positive.
  void turn(double* plane, const double* up) const {
    double side = 0;
    if (up != nullptr) side = (plane[0] * up[0] + plane[1] * up[1]) + plane[2] * up[2];
    if (side == 0 && !(std::fabs(plane[3]) < rules_.distance)) side = plane[3];
    if (side == 0) {
      side = plane[0];
      for (int axis = 1; axis < 3; ++axis)
        if (std::fabs(plane[axis]) > std::fabs(side)) side = plane[axis];
    }
    if (side < 0)
      for (int k = 0; k < 4; ++k) plane[k] = -plane[k];
  }

  const pc_context& context_;
  const float* points_;
  int64_t count_;
  const SearchRules& rules_;
};

}  // namespace
}  // namespace pc::planes

PC_EXPORT int32_t pc_ransac_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, const int64_t* words, int64_t num_draws, const int64_t* which,
                                   const double* guess, const double* up, double max_tilt, double distance,
                                   double missed, int64_t bits, double flat, int64_t rounds, double* planes,
                                   uint8_t* near, int64_t* found) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const SearchRules rules{{static_cast<float>(distance), flat, max_tilt, rounds}, distance, missed, bits};
    const auto own = [](const double* all, int64_t cloud, int64_t width) {
      return all == nullptr ? nullptr : all + width * cloud;
    };
    const auto find = [&](const pc_context& own_context, int64_t cloud) {
      const Draws draws{words + 3 * num_draws * which[cloud], num_draws};
      const double* upward = own(up, cloud, 3);
      PlaneOfCloud(own_context, points + 3 * ptr[cloud], ptr[cloud + 1] - ptr[cloud], rules)
          .find(draws, own(guess, cloud, 4), upward, max_tilt < 0 ? nullptr : upward, planes + 4 * cloud,
                near + ptr[cloud], found + 3 * cloud);
    };
    for_each_cloud(*context, ptr, num_clouds, 1, find);
  });
}
