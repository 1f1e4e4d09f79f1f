// Scratch memory of a call.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#include <vector>

namespace pc {

// Memory that the calling thread keeps between calls: fresh pages cost 2 us each, more than many kernels need to fill
// them. One arena per thread; a call takes slices of it and gives all back at its end (ScratchFrame).
class Arena {
 public:
  int num_frames = 0;  // that are open

  static Arena& mine() {
    static thread_local Arena arena;
    return arena;
  }
  template <class T>
  T* take(int64_t count) {
    constexpr size_t kAlign = 64;
    const size_t bytes = (static_cast<size_t>(std::max<int64_t>(count, 1)) * sizeof(T) + kAlign - 1) / kAlign * kAlign;
    if (blocks_.empty() || used_ + bytes > blocks_.back().size) grow(bytes);
    T* result = reinterpret_cast<T*>(blocks_.back().data.get() + used_);
    used_ += bytes;
    total_ += bytes;
    return result;
  }
  // How much is taken, to give back what is taken later.
  struct Mark {
    size_t blocks, used;
  };
  Mark mark() const { return {blocks_.size(), used_}; }
  void give_back(const Mark& mark) {
    if (blocks_.size() == mark.blocks) used_ = mark.used;
  }
  void reset() {
    // Next time one block holds what this call needed in several; a giant call's memory is not kept.
    const bool keep = total_ <= kKeep;
    if (blocks_.size() > 1 || !keep) {
      blocks_.clear();
      if (keep) grow(total_);
    }
    used_ = total_ = 0;
  }

 private:
  struct Free {
    void operator()(char* data) const { std::free(data); }
  };
  struct Block {
    std::unique_ptr<char, Free> data;
    size_t size;
  };
  static constexpr size_t kKeep = size_t{256} << 20;

  void grow(size_t at_least) {
    const size_t size = std::max(at_least, size_t{1} << 20);
    void* data = nullptr;
    if (posix_memalign(&data, 64, size) != 0) throw std::bad_alloc();
    blocks_.push_back({std::unique_ptr<char, Free>(static_cast<char*>(data)), size});
    used_ = 0;
  }
  std::vector<Block> blocks_;
  size_t used_ = 0;
  size_t total_ = 0;
};

// Gives the arena back when a kernel ends, however it ends; a frame within another gives back what it took itself.
struct ScratchFrame {
  Arena& arena = Arena::mine();
  Arena::Mark before = arena.mark();
  ScratchFrame() { ++arena.num_frames; }
  ScratchFrame(const ScratchFrame&) = delete;
  ScratchFrame& operator=(const ScratchFrame&) = delete;
  ~ScratchFrame() {
    if (--arena.num_frames == 0)
      arena.reset();
    else
      arena.give_back(before);
  }
  template <class T>
  T* take(int64_t count) {
    return arena.take<T>(count);
  }
};

}  // namespace pc
