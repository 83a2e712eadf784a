// C++11 wrapper of nertca_vk.h: handles that free themselves, failures as exceptions. Header only.
#ifndef NERTCA_VK_HPP
#define NERTCA_VK_HPP

#include "nertca_vk.h"

#include <cstdint>
#include <exception>
#include <functional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace nertca {

// A failed call: its status, and the library's text.
class Error : public std::runtime_error {
 public:
  Error(nertca_status status, const std::string &text) : std::runtime_error(text), status_(status) {}
  nertca_status status() const noexcept { return status_; }

 private:
  nertca_status status_;
};

namespace detail {

inline std::string last_error(const void *handle) {
  std::size_t length = 0;
  nertca_last_error(handle, nullptr, 0, &length);
  std::vector<char> text(length + 1);
  nertca_last_error(handle, text.data(), text.size(), nullptr);
  return text.data();
}

inline void check(nertca_status status, const void *handle) {
  if (status != NERTCA_OK) throw Error(status, last_error(handle));
}

// Owns a handle.
template <class Handle, nertca_status (*destroy)(Handle *)>
class Owner {
 public:
  Owner() = default;
  Owner(Owner &&other) noexcept : handle_(other.handle_) { other.handle_ = nullptr; }
  Owner &operator=(Owner &&other) noexcept {
    std::swap(handle_, other.handle_);
    return *this;
  }
  Owner(const Owner &) = delete;
  Owner &operator=(const Owner &) = delete;
  ~Owner() { destroy(handle_); }
  Handle *get() const noexcept { return handle_; }

 protected:
  Handle *handle_ = nullptr;
};

}  // namespace detail

// A struct of the C API, zero but for its size.
template <class Struct>
Struct make() {
  Struct value = Struct();
  value.size = sizeof(Struct);
  return value;
}

// A device. Reconstructions must be destroyed before it.
class Context : public detail::Owner<nertca_context, nertca_context_destroy> {
 public:
  explicit Context(const std::string &options = "", const nertca_log *log = nullptr) {
    detail::check(nertca_context_create(options.c_str(), log, &handle_), nullptr);
  }
  explicit Context(const nertca_vulkan &vulkan, const std::string &options = "", const nertca_log *log = nullptr) {
    detail::check(nertca_context_adopt(&vulkan, options.c_str(), log, &handle_), nullptr);
  }
  // JSON.
  std::string describe() const {
    std::size_t length = 0;
    detail::check(nertca_context_describe(handle_, nullptr, 0, &length), handle_);
    // What it says of memory may grow between the two calls.
    std::vector<char> text(length + 64);
    detail::check(nertca_context_describe(handle_, text.data(), text.size(), nullptr), handle_);
    return text.data();
  }
};

// A reconstruction. See nertca_vk.h for what each call does, and from which threads.
class Reconstruction : public detail::Owner<nertca_reconstruction, nertca_reconstruction_destroy> {
 public:
  // Told how far training is; returns whether to go on.
  using Observer = std::function<bool(const nertca_progress &)>;

  Reconstruction(const Context &context, const std::string &options) {
    detail::check(nertca_reconstruction_create(context.get(), options.c_str(), &handle_), context.get());
  }
  void add_frame(const nertca_frame &frame) { check(nertca_reconstruction_add_frame(handle_, &frame)); }
  // Frames count from 0 in the order in which they were added.
  nertca_correction correction(std::uint32_t frame) const {
    nertca_correction correction = make<nertca_correction>();
    check(nertca_reconstruction_correction(handle_, frame, &correction));
    return correction;
  }
  void set_geometry(std::uint32_t frame, const nertca_geometry &geometry) {
    check(nertca_reconstruction_set_geometry(handle_, frame, &geometry));
  }
  // For all frames of the frame's view.
  void set_view_geometry(std::uint32_t frame, const nertca_geometry &geometry) {
    check(nertca_reconstruction_set_view_geometry(handle_, frame, &geometry));
  }
  void remove_frame(std::uint32_t frame) { check(nertca_reconstruction_remove_frame(handle_, frame)); }
  nertca_frame_status frame_status(std::uint32_t frame) const {
    nertca_frame_status status = make<nertca_frame_status>();
    check(nertca_reconstruction_frame_status(handle_, frame, &status));
    return status;
  }
  // No times clear them.
  void set_r_peaks(const std::vector<double> &times_s) {
    check(nertca_reconstruction_set_r_peaks(handle_, times_s.empty() ? nullptr : times_s.data(), times_s.size()));
  }
  // Phase of a time by the R-peaks, usually between two: its whole part and the rest are `phase` and `after_phase` of a view.
  double beat_phase(double time_s) const {
    double phase = 0;
    check(nertca_reconstruction_beat_phase(handle_, time_s, &phase));
    return phase;
  }
  // Trains in this thread; returns the iterations done. An exception of the observer ends training and is thrown on.
  std::uint32_t train(std::uint32_t iterations, const Observer &observer = Observer()) {
    Call call = {&observer, nullptr};
    std::uint32_t done = 0;
    nertca_status status = nertca_reconstruction_train(handle_, iterations, observer ? tell : nullptr, &call, &done);
    if (call.thrown) std::rethrow_exception(call.thrown);
    if (status != NERTCA_ERROR_CANCELLED) check(status);
    return done;
  }
  void start() { check(nertca_reconstruction_start(handle_, nullptr, nullptr)); }
  void pause() { check(nertca_reconstruction_pause(handle_)); }
  void resume() { check(nertca_reconstruction_resume(handle_)); }
  void stop() { check(nertca_reconstruction_stop(handle_)); }
  bool wait(std::uint32_t limit_ms) {
    std::int32_t ended = 0;
    check(nertca_reconstruction_wait(handle_, limit_ms, &ended));
    return ended != 0;
  }
  nertca_progress progress() const {
    nertca_progress progress = make<nertca_progress>();
    check(nertca_reconstruction_progress(handle_, &progress));
    return progress;
  }
  // The vessels at all phases as trees of centrelines with radii.
  struct Tree {
    bool followed = false;  // all phases have the same material points
    std::vector<std::uint32_t> branch_phase, branch_first, branch_points;
    std::vector<std::int32_t> branch_parent;
    std::vector<double> points_mm;  // three numbers a point, LPS
    std::vector<double> radius_mm;
  };
  Tree tree(double threshold_per_mm = 0.0, double least_branch_mm = 0.0) {
    nertca_tree room = make<nertca_tree>();
    room.threshold_per_mm = threshold_per_mm;
    room.least_branch_mm = least_branch_mm;
    check(nertca_reconstruction_tree(handle_, &room));
    Tree tree;
    tree.followed = room.followed != 0;
    for (std::vector<std::uint32_t> *words : {&tree.branch_phase, &tree.branch_first, &tree.branch_points})
      words->resize(room.branches);
    tree.branch_parent.resize(room.branches);
    tree.points_mm.resize(3 * room.points);
    tree.radius_mm.resize(room.points);
    room.branch_phase = tree.branch_phase.data();
    room.branch_first = tree.branch_first.data();
    room.branch_points = tree.branch_points.data();
    room.branch_parent = tree.branch_parent.data();
    room.points_mm = tree.points_mm.data();
    room.radius_mm = tree.radius_mm.data();
    check(nertca_reconstruction_tree(handle_, &room));
    return tree;
  }
  // Line integrals (or attenuation per mm for maximum projections), rows first.
  std::vector<float> render(const nertca_view &view) {
    std::vector<float> pixels(static_cast<std::size_t>(view.width) * view.height);
    nertca_image image = make<nertca_image>();
    image.pixels = pixels.data();
    image.pixels_bytes = pixels.size() * sizeof(float);
    image.format = NERTCA_PIXELS_F32;
    check(nertca_reconstruction_render(handle_, &view, &image));
    return pixels;
  }
  // Which field the last live picture showed.
  nertca_drawn drawn() const {
    nertca_drawn drawn = make<nertca_drawn>();
    check(nertca_reconstruction_drawn(handle_, &drawn));
    return drawn;
  }
  // Ends `evaluate`, `tree`, `sample` and exact pictures in other threads, which throw NERTCA_ERROR_CANCELLED.
  void cancel() { check(nertca_reconstruction_cancel(handle_)); }
  // Attenuation per mm, left fastest.
  std::vector<float> sample(const nertca_grid &grid) {
    std::vector<float> values(static_cast<std::size_t>(grid.points[0]) * grid.points[1] * grid.points[2]);
    check(nertca_reconstruction_sample(handle_, &grid, values.data(), values.size()));
    return values;
  }
  // A byte for each point of the grid, left fastest: not zero inside vessels. None forget the grid's phase.
  void set_true_vessels(const nertca_grid &grid, const std::vector<std::uint8_t> &vessels) {
    const std::uint8_t *bytes = vessels.empty() ? nullptr : vessels.data();
    check(nertca_reconstruction_set_true_vessels(handle_, &grid, bytes, vessels.size()));
  }
  // As `tree` returns it; one without branches forgets what was said before.
  void set_true_tree(const Tree &tree) {
    nertca_tree truth = make<nertca_tree>();
    truth.branches = tree.branch_phase.size();
    truth.points = tree.radius_mm.size();
    truth.branch_phase = const_cast<std::uint32_t *>(tree.branch_phase.data());
    truth.branch_first = const_cast<std::uint32_t *>(tree.branch_first.data());
    truth.branch_points = const_cast<std::uint32_t *>(tree.branch_points.data());
    truth.points_mm = const_cast<double *>(tree.points_mm.data());
    truth.radius_mm = const_cast<double *>(tree.radius_mm.data());
    check(nertca_reconstruction_set_true_tree(handle_, &truth));
  }
  nertca_scores evaluate(double threshold_per_mm = 0) {
    nertca_scores scores = make<nertca_scores>();
    check(nertca_reconstruction_evaluate(handle_, threshold_per_mm, &scores));
    return scores;
  }
  void save(const std::string &path) { check(nertca_reconstruction_save(handle_, path.c_str())); }
  void load(const std::string &path) { check(nertca_reconstruction_load(handle_, path.c_str())); }

 private:
  struct Call {
    const Observer *observer;
    std::exception_ptr thrown;
  };
  static std::int32_t tell(const nertca_progress *progress, void *user) noexcept {
    Call &call = *static_cast<Call *>(user);
    try {
      return (*call.observer)(*progress) ? 0 : 1;
    } catch (...) {
      call.thrown = std::current_exception();
      return 1;
    }
  }
  void check(nertca_status status) const { detail::check(status, handle_); }
};

}  // namespace nertca

#endif
