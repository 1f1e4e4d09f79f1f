// The threads of one kernel call.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <pthread.h>
#include <sched.h>
#endif

namespace pc {

// Helpers of the thread that made it, from the first job until the end of the call: between calls no thread lives that
// a fork could break. A kernel has several short jobs, so helpers wait for the next one awake, for a while; and a job
// never waits for a helper that has not come yet, because starting a thread may take a millisecond.
class Crew {
 public:
  Crew() : outer_(current()) { current() = this; }
  Crew(const Crew&) = delete;
  Crew& operator=(const Crew&) = delete;
  ~Crew() {
    current() = outer_;
    wake(kQuit);
    for (auto& helper : helpers_) helper.join();
  }

  // The crew of the call that this thread is in; null in helpers.
  static Crew*& current() {
    static thread_local Crew* crew = nullptr;
    return crew;
  }

  // Call work(thread) here as thread 0 and, as far as they come in time, by helpers 1 to threads-1. Returns when nobody
  // works any more. `work` must not throw.
  template <class Work>
  void run(int64_t threads, Work& work) {
    work_ = [](void* object, int64_t thread) { (*static_cast<Work*>(object))(thread); };
    object_ = &work;
    wanted_ = threads;
    hire(threads - 1);
    present_.fetch_and(~kClosed);
    wake(kNext);
    work(0);
    present_.fetch_or(kClosed);
    while (present_.load() != kClosed) std::this_thread::yield();
  }

 private:
  static constexpr uint64_t kQuit = 1, kNext = 2;  // what to add to signal_
  static constexpr uint32_t kClosed = uint32_t{1} << 31;
  static constexpr int kLooks = 20000;  // some tens of microseconds

  void hire(int64_t wanted) {
    try {
      while (static_cast<int64_t>(helpers_.size()) < wanted) {
        const auto thread = static_cast<int64_t>(helpers_.size()) + 1;
        helpers_.emplace_back([this, thread, seen = signal_.load()] { serve(thread, seen); });
        move_elsewhere(helpers_.back());
      }
    } catch (...) {
      // No more threads to be had: the ones there are do the work.
    }
  }

  void serve(int64_t thread, uint64_t seen) {
    for (;;) {
      seen = next_signal(seen);
      if (seen & kQuit) return;
      // A job that is over, or being replaced, is closed: nothing of it is read then.
      if (!(present_.fetch_add(1) & kClosed) && thread < wanted_) work_(object_, thread);
      present_.fetch_sub(1);
    }
  }

  void wake(uint64_t change) {
    signal_.fetch_add(change);
    if (asleep_.load() == 0) return;
    { const std::lock_guard<std::mutex> lock(mutex_); }
    bell_.notify_all();
  }

  uint64_t next_signal(uint64_t seen) {
    for (int look = 0; look < kLooks; ++look)
      if (const uint64_t now = signal_.load(); now != seen) return now;
    std::unique_lock<std::mutex> lock(mutex_);
    asleep_.fetch_add(1);
    bell_.wait(lock, [&] { return signal_.load() != seen; });
    asleep_.fetch_sub(1);
    return signal_.load();
  }

  // Left to itself, Linux often starts a thread on its maker's processor, where it waits for the maker to pause.
  static void move_elsewhere(std::thread& helper) {
#if defined(__linux__)
    cpu_set_t allowed, others;
    const int here = sched_getcpu();
    if (here < 0 || sched_getaffinity(0, sizeof(allowed), &allowed) != 0) return;
    others = allowed;
    CPU_CLR(here, &others);
    if (CPU_COUNT(&others) == 0) return;
    pthread_setaffinity_np(helper.native_handle(), sizeof(others), &others);
    pthread_setaffinity_np(helper.native_handle(), sizeof(allowed), &allowed);  // free to go where it likes from there
#else
    (void)helper;
#endif
  }

  std::vector<std::thread> helpers_;
  std::mutex mutex_;
  std::condition_variable bell_;
  std::atomic<uint64_t> signal_{0};
  std::atomic<uint32_t> present_{kClosed};  // helpers at work, and whether others may still join
  std::atomic<int> asleep_{0};
  void (*work_)(void*, int64_t) = nullptr;
  void* object_ = nullptr;
  int64_t wanted_ = 0;
  Crew* outer_;
};

}  // namespace pc
