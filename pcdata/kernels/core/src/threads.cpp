// The threads of a kernel call.
#include "pc/threads.hpp"

#include <chrono>
#include <condition_variable>
#include <mutex>
#include <new>
#include <thread>

#if defined(__linux__)
#include <pthread.h>
#include <sched.h>
#endif

namespace pc {
namespace {

// Helpers of the thread that made it, from the first job until the end of the call: between calls no thread lives that
// a fork could break. A kernel has several short jobs, so helpers wait for the next one awake, for a while; and a job
// never waits for a helper that has not come yet, because starting a thread may take a millisecond.
class ThreadTeam {
 public:
  ThreadTeam() : outer_(current()) { current() = this; }
  ThreadTeam(const ThreadTeam&) = delete;
  ThreadTeam& operator=(const ThreadTeam&) = delete;
  ~ThreadTeam() {
    current() = outer_;
    wake(kQuit);
    for (auto& helper : helpers_) helper.join();
  }

  // The team of the call that this thread is in; null in helpers.
  static ThreadTeam*& current() {
    static thread_local ThreadTeam* team = nullptr;
    return team;
  }

  // Call work(thread) here as thread 0 and, as far as they come in time, by helpers 1 to threads-1. Returns when nobody
  // works any more. `work` must not throw.
  template <class Work>
  void run(int64_t threads, Work& work) {
    work_ = [](void* object, int64_t thread) { (*static_cast<Work*>(object))(thread); };
    object_ = &work;
    wanted_ = threads;
    start_helpers(threads - 1);
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

  void start_helpers(int64_t wanted) {
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
    wake_.notify_all();
  }

  uint64_t next_signal(uint64_t seen) {
    for (int look = 0; look < kLooks; ++look)
      if (const uint64_t now = signal_.load(); now != seen) return now;
    std::unique_lock<std::mutex> lock(mutex_);
    asleep_.fetch_add(1);
    wake_.wait(lock, [&] { return signal_.load() != seen; });
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
  std::condition_variable wake_;
  std::atomic<uint64_t> signal_{0};
  std::atomic<uint32_t> present_{kClosed};  // helpers at work, and whether others may still join
  std::atomic<int> asleep_{0};
  void (*work_)(void*, int64_t) = nullptr;
  void* object_ = nullptr;
  int64_t wanted_ = 0;
  ThreadTeam* outer_;
};

constexpr int64_t kBetweenPolls = 20'000'000;  // nanoseconds

int64_t now() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch())
      .count();
}

}  // namespace

int32_t run_call(void* body, void (*call)(void*)) noexcept {
  try {
    ThreadTeam team;
    call(body);
    return kOk;
  } catch (const std::bad_alloc&) {
    return kOutOfMemory;
  } catch (const Interrupted&) {
    return kInterrupted;
  } catch (...) {
    return kFailed;
  }
}

Poll::Poll(const pc_context& context) : context_(context), next_(context.poll == nullptr ? 0 : now() + kBetweenPolls) {}

void Poll::check() {
  if (context_.poll == nullptr || now() < next_) return;
  next_ = now() + kBetweenPolls;
  if (context_.poll() != 0) throw Interrupted();
}

void run_pieces(const pc_context& context, int64_t count, int64_t grain, PieceBody body) {
  if (count <= 0) return;
  const int64_t pieces = (count + grain - 1) / grain;
  ThreadTeam* team = ThreadTeam::current();
  const int64_t threads = team == nullptr ? 1 : std::max<int64_t>(1, std::min<int64_t>(context.threads, pieces));
  Poll poll(context);
  if (threads == 1) {
    for (int64_t piece = 0; piece < pieces; ++piece) {
      poll.check();
      body(piece * grain, std::min(count, (piece + 1) * grain), 0);
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
  team->run(threads, work);
  for (auto& error : errors)
    if (error) std::rethrow_exception(error);
}

std::vector<Range> even_pieces(const pc_context& context, int64_t count) {
  constexpr int64_t kSmallest = 1 << 13, kLargest = 1 << 22, kPerThread = 4;
  const int64_t wanted = std::max<int64_t>(count / kLargest, context.threads > 1 ? context.threads * kPerThread : 1);
  const int64_t pieces = std::max<int64_t>(1, std::min(wanted, count / kSmallest));
  std::vector<Range> result;
  for (int64_t p = 0; p < pieces; ++p) result.push_back({count * p / pieces, count * (p + 1) / pieces});
  return result;
}

std::vector<CloudPiece> cut_clouds(const int64_t* ptr, int64_t num_clouds, int64_t rows) {
  std::vector<CloudPiece> pieces;
  for (int64_t cloud = 0; cloud < num_clouds; ++cloud)
    for (int64_t begin = ptr[cloud]; begin < ptr[cloud + 1]; begin += rows)
      pieces.push_back({cloud, begin, std::min(ptr[cloud + 1], begin + rows)});
  return pieces;
}

}  // namespace pc
