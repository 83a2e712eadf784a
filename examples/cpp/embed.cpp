// The C++ wrapper in use: handles free themselves, failures are exceptions.
//
//   c++ -std=c++11 embed.cpp -I../c -o embed $(pkg-config --cflags --libs nertca_vk)
//   ./embed [ITERATIONS] [CONTEXT OPTIONS]
#include "nertca_vk.hpp"

extern "C" {
#include "../c/phantom.h"
}

#include <algorithm>
#include <cstdlib>
#include <iostream>

int main(int argc, char **argv) try {
  const std::uint32_t size = 64, iterations = argc > 1 ? std::atoi(argv[1]) : 100;
  nertca::Context context(argc > 2 ? argv[2] : "");
  nertca::Reconstruction reconstruction(
      context, "phases = " + std::to_string(PHANTOM_PHASES) + "\ntrain.iterations = " + std::to_string(iterations));

  std::vector<float> pixels(size * size);
  for (int phase = 0; phase < PHANTOM_PHASES; phase++)
    for (const auto &angles : phantom_views) {
      const nertca_geometry geometry = phantom_geometry(angles[0], angles[1], size);
      phantom_image(&geometry, size, phase, pixels.data(), nullptr);
      reconstruction.add_frame(phantom_frame(&geometry, size, phase, pixels.data(), nullptr));
    }

  const std::uint32_t done = reconstruction.train(iterations, [](const nertca_progress &progress) {
    if (progress.step % 50 == 0) std::cout << "iteration " << progress.step << ": " << progress.psnr_db << " dB\n";
    return true;
  });

  nertca_view view = nertca::make<nertca_view>();
  view.geometry = phantom_geometry(10, 20, 128);
  view.width = view.height = 128;
  view.component = NERTCA_COMPONENT_DYNAMIC;
  const std::vector<float> image = reconstruction.render(view);
  std::cout << done << " iterations; largest line integral of the vessels: "
            << *std::max_element(image.begin(), image.end()) << "\n";

  try {
    view.phase = 99;
    reconstruction.render(view);
    return 1;
  } catch (const nertca::Error &error) {
    std::cout << "as it should, a phase too many is refused: " << error.what() << "\n";
  }
  return 0;
} catch (const std::exception &error) {
  std::cerr << error.what() << "\n";
  return 1;
}
