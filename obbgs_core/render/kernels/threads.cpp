#include "threads.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>

namespace obbgs {
namespace {

using Clock = std::chrono::steady_clock;

// Waking a thread costs some tenths of a millisecond: it pays to look this long for what is about to happen.
constexpr std::chrono::microseconds kPatience{300};

// Returns whether done() comes true soon; meanwhile whoever waits for this core gets it.
template <typename Done>
bool soon(Done done) {
  for (const auto until = Clock::now() + kPatience; !done();) {
    if (Clock::now() > until) return false;
    std::this_thread::yield();
  }
  return true;
}

class Pool {
 public:
  void run(int units, int threads, const std::function<void(int)>& work) {
    const int helpers = std::min(threads, units) - 1;
    std::unique_lock<std::mutex> only(callers_, std::try_to_lock);
    if (helpers < 1 || !only || alone_ > 0) {
      if (only && alone_ > 0) --alone_;
      for (int unit = 0; unit < units; ++unit) work(unit);
      return;
    }
    for (; started_ < helpers; ++started_) std::thread([this] { wait_for_work(); }).detach();
    {
      std::lock_guard<std::mutex> lock(mutex_);
      work_ = &work;
      units_ = units;
      next_ = 0;
      error_ = nullptr;
      wanted_ = helpers;
    }
    for (int i = 0; i < helpers; ++i) wake_.notify_one();
    const auto begun = Clock::now();
    drain();
    const auto drained = Clock::now();
    std::unique_lock<std::mutex> lock(mutex_);
    wanted_ = 0;
    lock.unlock();
    soon([this] { return active_ == 0; });
    lock.lock();
    idle_.wait(lock, [this] { return active_ == 0; });
    const bool late = Clock::now() - drained > (drained - begun) / 2 + std::chrono::microseconds(200);
    penalty_ = late ? std::min(2 * penalty_ + 4, 100) : penalty_ / 2;
    alone_ = late ? penalty_ : 0;
    if (error_) std::rethrow_exception(error_);
  }

 private:
  void drain() {
    try {
      for (int unit; (unit = next_.fetch_add(1)) < units_;) (*work_)(unit);
    } catch (...) {
      std::lock_guard<std::mutex> lock(mutex_);
      if (!error_) error_ = std::current_exception();
    }
  }

  void wait_for_work() {
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
      lock.unlock();
      soon([this] { return wanted_ > 0; });
      lock.lock();
      wake_.wait(lock, [this] { return wanted_ > 0; });
      --wanted_;
      ++active_;
      lock.unlock();
      drain();
      lock.lock();
      if (--active_ == 0) idle_.notify_one();
    }
  }

  std::mutex callers_, mutex_;
  std::condition_variable wake_, idle_;
  const std::function<void(int)>* work_ = nullptr;
  std::atomic<int> next_{0}, wanted_{0}, active_{0};  // the last two change under the mutex
  std::exception_ptr error_;
  int units_ = 0, started_ = 0;
  int alone_ = 0, penalty_ = 0;  // loops to run alone yet, and after the next late helper
};

}  // namespace

void parallel_for(int units, int threads, const std::function<void(int)>& work) {
  static Pool& pool = *new Pool;  // never destroyed: its threads wait in it until the process ends
  pool.run(units, threads, work);
}

}  // namespace obbgs
