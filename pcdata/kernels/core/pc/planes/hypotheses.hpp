// The planes that a search tries: through three points each, that random words choose.
#pragma once

#include "pc/memory.hpp"
#include "pc/planes/refinement.hpp"

namespace pc::planes {

// Words (3, count): modulo the number of rows left they are rows, each of which skips over those before it.
struct Draws {
  const int64_t* words;
  int64_t count;

  math::Vector3 corner(const float* points, int64_t row) const { return math::vector_of(points + 3 * row); }
  void plane(const float* points, int64_t num_points, int64_t at, double flat, double* to) const {
    const int64_t first = words[at] % num_points;
    int64_t second = words[count + at] % (num_points - 1), third = words[2 * count + at] % (num_points - 2);
    second += second >= first;
    const int64_t low = std::min(first, second), high = std::max(first, second);
    third += third >= low;
    third += third >= high;
    math::plane_through(corner(points, first), corner(points, second), corner(points, third), flat, to);
  }
};

// Hypotheses about one cloud of three points or more: a guess, if there is one, and planes that are made when needed.
class Hypotheses {
 public:
  Hypotheses(const float* points, int64_t num_points, const Draws& draws, const double* guess, const double* up,
             const RefinementRules& rules, ScratchFrame& scratch)
      : points_(points),
        num_points_(num_points),
        draws_(draws),
        guess_(guess),
        up_(up),
        rules_(rules),
        count_(draws.count + num_guesses()),
        planes_(scratch.take<double>(4 * count_)),
        rounded_(scratch.take<Plane>(count_)),
        competes_(scratch.take<uint8_t>(count_)) {}

  int64_t count() const { return count_; }
  int64_t num_guesses() const { return guess_ == nullptr ? 0 : 1; }
  const double* plane(int64_t at) const { return planes_ + 4 * at; }
  const Plane* rounded_planes() const { return rounded_; }
  const uint8_t* competes() const { return competes_; }

  void make(int64_t first, int64_t some) const {
    for (int64_t at = first; at < first + some; ++at) {
      double* to = planes_ + 4 * at;
      if (at < num_guesses())
        std::copy_n(guess_, 4, to);
      else
        draws_.plane(points_, num_points_, at - num_guesses(), rules_.flat, to);
      rounded_[at] = rounded(to);
      competes_[at] = static_cast<uint8_t>(to[0] == to[0] && is_within_tilt(to, up_, rules_.max_tilt));
    }
  }

  // How many of all are planes, and how many of those compete.
  std::pair<int64_t, int64_t> num_planes() const {
    int64_t found = 0, competing = 0;
    for (int64_t at = 0; at < count_; ++at) {
      found += static_cast<int64_t>(planes_[4 * at] == planes_[4 * at]);
      competing += competes_[at];
    }
    return {found, competing};
  }

 private:
  const float* points_;
  int64_t num_points_;
  const Draws& draws_;
  const double *guess_, *up_;
  const RefinementRules& rules_;
  int64_t count_;
  double* planes_;
  Plane* rounded_;
  uint8_t* competes_;
};

}  // namespace pc::planes
