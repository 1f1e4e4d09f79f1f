// The threads of a kernel call.
#include "pc/threads.hpp"

#include <chrono>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <new>
#include <thread>

#if !defined(_WIN32)
#include <pthread.h>
#endif
#if defined(__linux__)
#include <sched.h>
#endif

namespace pc {
namespace {

// Helpers of the thread that made it. Starting one takes as long as a short kernel, so they live on for a while after a
// call, for the next one. A kernel has several short jobs, so helpers wait for the next one awake at first; and a job
// never waits for a helper that has not come yet, because starting a thread may take a millisecond.
class ThreadTeam {
 public:
  ThreadTeam() = default;
  ThreadTeam(const ThreadTeam&) = delete;
  ThreadTeam& operator=(const ThreadTeam&) = delete;
  ~ThreadTeam() {
    wake(kQuit);
    for (auto& helper : helpers_)
      if (helper->thread.joinable()) helper->thread.join();
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
  static constexpr std::chrono::microseconds kAwake{150};  // what Python takes between most kernels of a chain
  static constexpr std::chrono::milliseconds kStays{50};

  // Leave what two threads of one core share to the other for a moment.
  static void breathe() {
#if defined(__x86_64__) && defined(__GNUC__)
    __builtin_ia32_pause();
#elif defined(__aarch64__) && defined(__GNUC__)
    __asm__ volatile("yield");
#endif
  }

  struct Helper {
    std::thread thread;
    std::atomic<bool> is_gone{false};
  };

  void start_helpers(int64_t wanted) {
    size_t first_new = helpers_.size();
    try {
      for (int64_t i = 0; i < wanted; ++i) {
        if (i == static_cast<int64_t>(helpers_.size())) helpers_.push_back(std::make_unique<Helper>());
        Helper& helper = *helpers_[static_cast<size_t>(i)];
        if (helper.is_gone.load() && helper.thread.joinable()) helper.thread.join();
        if (helper.thread.joinable()) continue;
        helper.is_gone.store(false);
        helper.thread = std::thread([this, &helper, i, seen = signal_.load()] { serve(helper, i + 1, seen); });
        first_new = std::min(first_new, static_cast<size_t>(i));
      }
    } catch (...) {
      // No more threads to be had: the ones there are do the work.
    }
    keep_elsewhere(first_new);
  }

  void serve(Helper& helper, int64_t thread, uint64_t seen) {
#if defined(__linux__)
    pthread_setname_np(pthread_self(), "pcdata");
#endif
    for (;;) {
      const uint64_t now = next_signal(seen);
      if (now == seen || (now & kQuit)) {
        std::lock_guard<std::mutex> lock(mutex_);
        return helper.is_gone.store(true);
      }
      seen = now;
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

  // The next signal; or the same again, when none came for long.
  uint64_t next_signal(uint64_t seen) {
    using Clock = std::chrono::steady_clock;
    for (const auto end = Clock::now() + kAwake; Clock::now() < end;)
      for (int look = 0; look < 16; ++look, breathe())
        if (const uint64_t now = signal_.load(); now != seen) return now;
    std::unique_lock<std::mutex> lock(mutex_);
    asleep_.fetch_add(1);
    wake_.wait_for(lock, kStays, [&] { return signal_.load() != seen; });
    asleep_.fetch_sub(1);
    return signal_.load();
  }

  // Left to itself, Linux often runs a thread on the processor of who starts or wakes it, where it waits for that one
  // to pause: keep helpers where this thread may run, but is not.
  void keep_elsewhere(size_t first_new) {
#if defined(__linux__)
    cpu_set_t allowed;
    const int here = sched_getcpu();
    if (here < 0 || sched_getaffinity(0, sizeof(allowed), &allowed) != 0) return;
    const bool is_known = here == here_ && CPU_EQUAL(&allowed, &allowed_);
    here_ = here;
    allowed_ = allowed;
    if (CPU_COUNT(&allowed) > 1) CPU_CLR(here, &allowed);
    const size_t first = is_known ? first_new : 0;
    if (first >= helpers_.size()) return;
    std::lock_guard<std::mutex> lock(mutex_);  // none goes meanwhile: for a thread that has ended glibc moves this one
    for (size_t i = first; i < helpers_.size(); ++i)
      if (helpers_[i]->thread.joinable() && !helpers_[i]->is_gone.load())
        pthread_setaffinity_np(helpers_[i]->thread.native_handle(), sizeof(allowed), &allowed);
#else
    (void)first_new;
#endif
  }

#if defined(__linux__)
  int here_ = -1;
  cpu_set_t allowed_{};
#endif
  std::vector<std::unique_ptr<Helper>> helpers_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::atomic<uint64_t> signal_{0};
  std::atomic<uint32_t> present_{kClosed};  // helpers at work, and whether others may still join
  std::atomic<int> asleep_{0};
  void (*work_)(void*, int64_t) = nullptr;
  void* object_ = nullptr;
  int64_t wanted_ = 0;
};

// The team of a call, while it lasts.
class InTeam {
 public:
  explicit InTeam(ThreadTeam& team) : outer_(ThreadTeam::current()) { ThreadTeam::current() = &team; }
  InTeam(const InTeam&) = delete;
  InTeam& operator=(const InTeam&) = delete;
  ~InTeam() { ThreadTeam::current() = outer_; }

 private:
  ThreadTeam* outer_;
};

#if !defined(_WIN32)  // where a library that is unloaded must not wait for threads
// The team that a thread keeps. None lives where the process forks: its helpers would be missing in the child, and who
// forks may ask that there is one thread alone.
struct KeptTeam {
  std::unique_ptr<ThreadTeam> team;

  static ThreadTeam& of_this_thread() {
    KeptTeam& kept = mine();
    if (kept.team == nullptr) {
      static const bool ended_by_forks = end_by_forks();
      (void)ended_by_forks;
      kept.team = std::make_unique<ThreadTeam>();
    }
    return *kept.team;
  }

 private:
  static KeptTeam& mine() {
    static thread_local KeptTeam kept;
    return kept;
  }
  static bool end_by_forks() {
    // From within a call, which polls Python, it lives on: it is at work. The child can neither use nor end it.
    const auto before = [] {
      if (ThreadTeam::current() == nullptr) mine().team.reset();
    };
    const auto in_child = [] { static_cast<void>(mine().team.release()); };
    return pthread_atfork(before, nullptr, in_child) == 0;
  }
};
#endif

void run_in(ThreadTeam& team, void* body, void (*call)(void*)) {
  const InTeam in_team(team);
  call(body);
}

constexpr int64_t kBetweenPolls = 20'000'000;  // nanoseconds

int64_t now() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch())
      .count();
}

}  // namespace

int32_t run_call(void* body, void (*call)(void*)) noexcept {
  try {
#if !defined(_WIN32)
    if (ThreadTeam::current() == nullptr) {
      run_in(KeptTeam::of_this_thread(), body, call);
      return kOk;
    }
#endif
    ThreadTeam own;  // within a call, by what it polls, the kept team is at work
    run_in(own, body, call);
    return kOk;
  } catch (const std::bad_alloc&) {
    return kOutOfMemory;
  } catch (const Interrupted&) {
    return kInterrupted;
  } catch (const TooManyRows&) {
    return kTooManyRows;
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
