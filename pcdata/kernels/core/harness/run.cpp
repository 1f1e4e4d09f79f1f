// Runs the kernels of pc/gpu on the processor: see threads.hpp. A library of its own, for tests alone.
#include <ucontext.h>

#include <algorithm>
#include <cstdio>
#include <map>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/asan_interface.h>
#include <sanitizer/common_interface_defs.h>
#endif

#include "harness/kernels.hpp"

namespace pc::harness {

Here* here = nullptr;

namespace {

constexpr std::size_t kStack = 128 << 10;
constexpr int kWarp = 32;

struct Kernel {
  Run run;
  int arguments;
  Meets meets;
};

std::map<std::string, Kernel>& kernels() {
  static std::map<std::string, Kernel> all;
  return all;
}

// Stacks of fibers that have ended, for those to come: new memory would have to be cleared page by page.
std::vector<std::unique_ptr<char[]>>& spare_stacks() {
  static std::vector<std::unique_ptr<char[]>> stacks;
  return stacks;
}

std::unique_ptr<char[]> take_stack() {
  auto& spare = spare_stacks();
  if (spare.empty()) return std::unique_ptr<char[]>(new char[kStack]);
  auto stack = std::move(spare.back());
  spare.pop_back();
  return stack;
}

void give_back(std::unique_ptr<char[]> stack) {
#if defined(__SANITIZE_ADDRESS__)
  ASAN_UNPOISON_MEMORY_REGION(stack.get(), kStack);  // what the fiber was forbidden to touch
#endif
  constexpr std::size_t kMost = 1 << 11;
  if (spare_stacks().size() < kMost) spare_stacks().push_back(std::move(stack));
}

// Where a number of fibers wait for one another.
struct Meeting {
  int expected = 0;
  std::vector<int> waiting;
};

struct Fiber {
  ucontext_t context;
  Here here;
  std::unique_ptr<char[]> stack;
  void* fake_stack = nullptr;
};

// The threads that are alive together: those of one block, or of all.
class Group {
 public:
  Group(const Kernel& kernel, const uint64_t* arguments, int64_t first_block, int64_t blocks_here, int64_t blocks,
        int block_size, std::mt19937_64* order)
      : kernel_(kernel), arguments_(arguments), first_block_(first_block), block_size_(block_size), order_(order) {
    const int warps = (block_size + kWarp - 1) / kWarp;
    blocks_.resize(blocks_here);
    grid_.expected = static_cast<int>(blocks_here * block_size);
    for (int64_t b = 0; b < blocks_here; ++b) {
      blocks_[b].meeting.expected = block_size;
      blocks_[b].warps.resize(warps);
      blocks_[b].exchange.resize(2 * kWarp * warps);
      for (int w = 0; w < warps; ++w) blocks_[b].warps[w].expected = std::min(kWarp, block_size - w * kWarp);
      for (int t = 0; t < block_size; ++t) {
        fibers_.push_back(std::make_unique<Fiber>());
        fibers_.back()->here = {t, block_size, first_block + b, blocks, 0};
        ready_.push_back(static_cast<int>(fibers_.size()) - 1);
      }
    }
  }

  // Run all threads to their ends.
  void run() {
    at_work_ = this;
    int ended = 0;
    while (!ready_.empty()) {
      const std::size_t place = order_ ? (*order_)() % ready_.size() : 0;
      current_ = ready_[place];
      if (order_) {
        ready_[place] = ready_.back();
        ready_.pop_back();
      } else {
        ready_.erase(ready_.begin());
      }
      enter(*fibers_[current_]);
      if (ended_) ++ended;
      if (!told_.empty()) throw std::runtime_error(told_);
    }
    if (ended < static_cast<int>(fibers_.size()))
      throw std::runtime_error(std::to_string(fibers_.size() - ended) + " of " + std::to_string(fibers_.size()) +
                               " threads wait for others that have returned or wait elsewhere");
  }

  static Group& at_work() {
    if (at_work_ == nullptr) throw std::logic_error("threads meet in a kernel that does not say so");
    return *at_work_;
  }
  static void nobody_works() { at_work_ = nullptr; }

  void meet(Meeting& meeting) {
    if (static_cast<int>(meeting.waiting.size()) + 1 == meeting.expected) {
      ready_.insert(ready_.end(), meeting.waiting.begin(), meeting.waiting.end());
      meeting.waiting.clear();
      ready_.push_back(current_);
    } else {
      meeting.waiting.push_back(current_);
    }
    leave(*fibers_[current_], false);
  }
  void meet_block() { meet(block().meeting); }
  void meet_warp() { meet(block().warps[here->thread / kWarp]); }
  void meet_grid() {
    if (kernel_.meets != Meets::kInGrid) throw std::logic_error("all threads meet in a kernel that does not say so");
    meet(grid_);
  }

  void* shared(const void* name, int64_t bytes) {
    auto& memory = block().shared[name];
    if (memory.empty()) memory.assign((bytes + 7) / 8, 0xA5A5A5A5A5A5A5A5u);
    return memory.data();
  }
  uint64_t* exchange(int table) { return block().exchange.data() + (2 * (here->thread / kWarp) + table) * kWarp; }

 private:
  struct Block {
    Meeting meeting;
    std::vector<Meeting> warps;
    std::vector<uint64_t> exchange;
    std::map<const void*, std::vector<uint64_t>> shared;
  };

  Block& block() { return blocks_[here->block - first_block_]; }

  void enter(Fiber& fiber) {
    here = &fiber.here;
    ended_ = false;
    if (!fiber.stack) {
      fiber.stack = take_stack();
      getcontext(&fiber.context);
      fiber.context.uc_stack.ss_sp = fiber.stack.get();
      fiber.context.uc_stack.ss_size = kStack;
      fiber.context.uc_link = nullptr;
      makecontext(&fiber.context, &Group::live, 0);
    }
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_start_switch_fiber(&own_fake_stack_, fiber.stack.get(), kStack);
#endif
    swapcontext(&scheduler_, &fiber.context);
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_finish_switch_fiber(own_fake_stack_, nullptr, nullptr);
#endif
    if (ended_) give_back(std::move(fiber.stack));
  }

  void leave(Fiber& fiber, bool for_good) {
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_start_switch_fiber(for_good ? nullptr : &fiber.fake_stack, own_stack_, own_stack_size_);
#else
    (void)for_good;
#endif
    swapcontext(&fiber.context, &scheduler_);
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_finish_switch_fiber(fiber.fake_stack, nullptr, nullptr);
#endif
  }

  static void live() {
    Group& group = *at_work_;
    Fiber& fiber = *group.fibers_[group.current_];
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_finish_switch_fiber(nullptr, &group.own_stack_, &group.own_stack_size_);
#endif
    try {
      group.kernel_.run(group.arguments_);
    } catch (const std::exception& error) {  // it cannot leave the fiber
      group.told_ = error.what();
    }
    group.ended_ = true;
    group.leave(fiber, true);
  }

  static Group* at_work_;
  const Kernel& kernel_;
  const uint64_t* arguments_;
  int64_t first_block_;
  int block_size_;
  std::mt19937_64* order_;
  std::vector<Block> blocks_;
  std::vector<std::unique_ptr<Fiber>> fibers_;
  std::vector<int> ready_;
  Meeting grid_;
  ucontext_t scheduler_;
  int current_ = 0;
  bool ended_ = false;
  std::string told_;
#if defined(__SANITIZE_ADDRESS__)
  void* own_fake_stack_ = nullptr;
  const void* own_stack_ = nullptr;
  std::size_t own_stack_size_ = 0;
#endif
};

Group* Group::at_work_ = nullptr;

std::vector<int64_t> numbered(int64_t count, std::mt19937_64* order) {
  std::vector<int64_t> numbers(count);
  for (int64_t i = 0; i < count; ++i) numbers[i] = i;
  if (order) std::shuffle(numbers.begin(), numbers.end(), *order);
  return numbers;
}

void run_grid(const Kernel& kernel, const uint64_t* arguments, int64_t blocks, int block_size, std::mt19937_64* order) {
  Group::nobody_works();
  if (kernel.meets == Meets::kInGrid) {
    Group(kernel, arguments, 0, blocks, blocks, block_size, order).run();
  } else if (kernel.meets == Meets::kInBlocks) {
    for (const int64_t block : numbered(blocks, order))
      Group(kernel, arguments, block, 1, blocks, block_size, order).run();
  } else {
    Here thread{0, block_size, 0, blocks, 0};
    here = &thread;
    for (const int64_t i : numbered(blocks * block_size, order)) {
      thread.thread = static_cast<int>(i % block_size);
      thread.block = i / block_size;
      kernel.run(arguments);
    }
  }
  Group::nobody_works();
}

}  // namespace

bool list(const char* name, Run run, int arguments, Meets meets) {
  return kernels().emplace(name, Kernel{run, arguments, meets}).second;
}

void meet_block() { Group::at_work().meet_block(); }
void meet_warp() { Group::at_work().meet_warp(); }
void meet_grid() { Group::at_work().meet_grid(); }
void* shared(const void* name, int64_t bytes) { return Group::at_work().shared(name, bytes); }
uint64_t* exchange(int table) { return Group::at_work().exchange(table); }

}  // namespace pc::harness

// Run one kernel over a grid; seed 0: in order, others: in an order of their own. Returns 0, or 1 with a message.
extern "C" __attribute__((visibility("default"))) int pc_run_kernel(const char* name, int64_t blocks,
                                                                    int64_t block_size, const uint64_t* arguments,
                                                                    int64_t count, uint64_t seed, char* message,
                                                                    int64_t room) {
  using namespace pc::harness;
  try {
    const auto found = kernels().find(name);
    if (found == kernels().end()) throw std::invalid_argument("there is no such kernel");
    if (count != found->second.arguments) throw std::invalid_argument("another number of arguments");
    std::mt19937_64 order(seed);
    run_grid(found->second, arguments, blocks, static_cast<int>(block_size), seed ? &order : nullptr);
    return 0;
  } catch (const std::exception& error) {
    std::snprintf(message, static_cast<std::size_t>(room), "%s: %s", name, error.what());
    return 1;
  }
}
