// Where between rising borders a number lies.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

namespace pc::images {

// Counts the borders (count,) that are not above a number: as a bisection would, from a table over even steps that says
// where to begin.
class Borders {
 public:
  Borders(const double* border, int64_t count, double low, double high)
      : border_(border),
        count_(count),
        low_(low),
        per_length_(static_cast<double>(kPerBorder * count + 1) / (high - low)) {
    before_.assign(static_cast<size_t>(kPerBorder * count + 2), 0);
    for (int64_t i = 0; i < count; ++i) ++before_[static_cast<size_t>(step(border[i]) + 1)];
    for (size_t i = 1; i < before_.size(); ++i) before_[i] += before_[i - 1];
  }

  int64_t count_upto(double value) const {
    // Borders of earlier steps are below, those of later ones above: step() rises.
    int64_t found = before_[static_cast<size_t>(step(value))];
    while (found < count_ && border_[found] <= value) ++found;
    return found;
  }

 private:
  static constexpr int64_t kPerBorder = 4;

  int64_t step(double value) const {
    const double at = (value - low_) * per_length_, last = static_cast<double>(kPerBorder * count_);
    return static_cast<int64_t>(at > 0 ? (at < last ? at : last) : 0.0);
  }

  const double* border_;
  int64_t count_;
  double low_, per_length_;
  std::vector<int32_t> before_;  // borders in earlier steps
};

}  // namespace pc::images
