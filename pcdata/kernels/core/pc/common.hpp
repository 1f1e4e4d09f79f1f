// What every kernel shares: the call context, threads, scratch memory, and how a call ends.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <memory>
#include <new>
#include <vector>

#include "pc/threads.hpp"

#define PC_EXPORT extern "C" __attribute__((visibility("default")))

// What Python passes to every call.
struct pc_context {
  int32_t threads;      // how many may work, the caller included
  int32_t (*poll)();    // asked now and then by the calling thread; non-zero = stop (Ctrl-C); may be null
};

namespace pc {

enum Status : int32_t { kOk = 0, kOutOfMemory = 1, kInterrupted = 2, kFailed = 3 };

struct Interrupted : std::exception {};

using std::int32_t;
using std::int64_t;
using std::uint32_t;
using std::uint64_t;
using std::uint8_t;

// Run a kernel's body and turn its end into a status: no exception crosses the C interface.
template <class Body>
int32_t guarded(Body&& body) noexcept {
  try {
    Crew crew;
    body();
    return kOk;
  } catch (const std::bad_alloc&) {
    return kOutOfMemory;
  } catch (const Interrupted&) {
    return kInterrupted;
  } catch (...) {
    return kFailed;
  }
}

// Asks Python for an interrupt at most every 20 ms; used by the calling thread only.
class Poll {
 public:
  explicit Poll(const pc_context& context) : context_(context), next_(Clock::now() + kEvery) {}

  bool stop() {
    if (context_.poll == nullptr || Clock::now() < next_) return false;
    next_ = Clock::now() + kEvery;
    return context_.poll() != 0;
  }
  void check() {
    if (stop()) throw Interrupted();
  }

 private:
  using Clock = std::chrono::steady_clock;
  static constexpr std::chrono::milliseconds kEvery{20};
  const pc_context& context_;
  Clock::time_point next_;
};

// Call body(begin, end, thread) over [0, count) in pieces of `grain` by up to context.threads threads. Pieces may run in
// any order, so bodies write disjoint results. A long piece delays Ctrl-C: keep it well under a second.
//
// Every thread has a stretch of its own, the same in every loop over the same pieces, so that it meets what it has in its
// cache; one that is done helps the others.
template <class Body>
void parallel_for(const pc_context& context, int64_t count, int64_t grain, Body&& body) {
  if (count <= 0) return;
  const int64_t pieces = (count + grain - 1) / grain;
  Crew* crew = Crew::current();
  const int64_t threads = crew == nullptr ? 1 : std::max<int64_t>(1, std::min<int64_t>(context.threads, pieces));
  Poll poll(context);
  if (threads == 1) {
    for (int64_t piece = 0; piece < pieces; ++piece) {
      poll.check();
      body(piece * grain, std::min(count, (piece + 1) * grain), int64_t{0});
    }
    return;
  }
  struct alignas(64) Stretch {
    std::atomic<int64_t> next;
    int64_t end;
  };
  std::vector<Stretch> stretches(static_cast<size_t>(threads));
  for (int64_t t = 0; t < threads; ++t) {
    stretches[static_cast<size_t>(t)].next.store(pieces * t / threads, std::memory_order_relaxed);
    stretches[static_cast<size_t>(t)].end = pieces * (t + 1) / threads;
  }
  std::atomic<bool> stop{false};
  std::vector<std::exception_ptr> errors(static_cast<size_t>(threads));
  auto work = [&](int64_t thread) {
    try {
      for (int64_t turn = 0; turn < threads; ++turn) {
        Stretch& stretch = stretches[static_cast<size_t>((thread + turn) % threads)];
        while (!stop.load(std::memory_order_relaxed)) {
          if (thread == 0) poll.check();
          const int64_t piece = stretch.next.fetch_add(1, std::memory_order_relaxed);
          if (piece >= stretch.end) break;
          body(piece * grain, std::min(count, (piece + 1) * grain), thread);
        }
      }
    } catch (...) {
      errors[static_cast<size_t>(thread)] = std::current_exception();
      stop.store(true);
    }
  };
  crew->run(threads, work);
  for (auto& error : errors)
    if (error) std::rethrow_exception(error);
}

// Memory that the calling thread keeps between calls: fresh pages cost 2 us each, more than many kernels need to fill
// them. One arena per thread; a call takes slices of it and gives all back at its end (ScratchFrame).
class Arena {
 public:
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

// Gives the arena back when a kernel ends, however it ends. Kernels do not call one another.
struct ScratchFrame {
  Arena& arena = Arena::mine();
  ScratchFrame() = default;
  ScratchFrame(const ScratchFrame&) = delete;
  ScratchFrame& operator=(const ScratchFrame&) = delete;
  ~ScratchFrame() { arena.reset(); }
  template <class T>
  T* take(int64_t count) {
    return arena.take<T>(count);
  }
};

}  // namespace pc
