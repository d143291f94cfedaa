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

// How long threads poll before they sleep: waking a sleeping one takes some tenths of a millisecond.
constexpr std::chrono::microseconds kPollTime{300};
constexpr std::chrono::microseconds kTolerance{200};  // a helper that ends this long after the caller is not late yet
constexpr int kMostSerialLoops = 100;                 // after a late helper

// Polls until done() is true or kPollTime is over; meanwhile other threads may have the core.
template <typename Done>
void poll(Done done) {
  for (const auto until = Clock::now() + kPollTime; !done() && Clock::now() <= until;) std::this_thread::yield();
}

class Pool {
 public:
  void run(int units, int threads, const std::function<void(int)>& work) {
    const int helpers = std::min(threads, units) - 1;
    std::unique_lock<std::mutex> only_caller(callers_, std::try_to_lock);
    if (helpers < 1 || !only_caller || serial_loops_left_ > 0) {
      if (only_caller && serial_loops_left_ > 0) --serial_loops_left_;
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
    poll([this] { return active_ == 0; });
    lock.lock();
    idle_.wait(lock, [this] { return active_ == 0; });
    const bool late = Clock::now() - drained > (drained - begun) / 2 + kTolerance;
    backoff_ = late ? std::min(2 * backoff_ + 4, kMostSerialLoops) : backoff_ / 2;
    serial_loops_left_ = late ? backoff_ : 0;
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
      poll([this] { return wanted_ > 0; });
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
  std::atomic<int> next_{0}, wanted_{0}, active_{0};  // wanted_ and active_ change only under mutex_
  std::exception_ptr error_;
  int units_ = 0, started_ = 0;
  int serial_loops_left_ = 0, backoff_ = 0;  // loops to run without helpers: now, and after the last late helper
};

}  // namespace

void parallel_for(int units, int threads, const std::function<void(int)>& work) {
  static Pool& pool = *new Pool;  // never destroyed: its threads use it until the process ends
  pool.run(units, threads, work);
}

}  // namespace obbgs
