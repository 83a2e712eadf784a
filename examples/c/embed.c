/* The whole life of a reconstruction: frames in, training with progress, a view, a volume, scores, a checkpoint.
 *
 *   cc embed.c -o embed $(pkg-config --cflags --libs nertca_vk) -lm
 *   ./embed [ITERATIONS] [CONTEXT OPTIONS] [PICTURE.png]
 */
#include "nertca_vk.h"
#include "phantom.h"
#include "png.h"

#include <stdio.h>
#include <stdlib.h>

#define SIZE 64u

/* Ends the program with the library's own words. `handle` is what the call was made on. */
static void check(nertca_status status, const void *handle, const char *call) {
  char text[512] = "";
  if (status == NERTCA_OK) return;
  nertca_last_error(handle, text, sizeof text, NULL);
  fprintf(stderr, "%s: %s: %s\n", call, nertca_status_text(status), text);
  exit(1);
}

static int on_progress(const nertca_progress *progress, void *user) {
  uint32_t *told = user;
  if (progress->step >= *told) {
    printf("iteration %u of %u: loss %.3e, PSNR %.1f dB\n", progress->step, progress->iterations, progress->loss,
           progress->psnr_db);
    *told = progress->step + 50;
  }
  return 0; /* anything else would end training */
}

static void on_log(uint32_t level, const char *text, void *user) {
  (void)user;
  fprintf(stderr, "[%s] %s\n", level == NERTCA_LOG_ERROR ? "error" : level == NERTCA_LOG_WARNING ? "warning" : "info", text);
}

int main(int argc, char **argv) {
  uint32_t iterations = argc > 1 ? (uint32_t)atoi(argv[1]) : 300;
  const char *options = argc > 2 ? argv[2] : "";
  const char *picture = argc > 3 ? argv[3] : "embed.png";
  nertca_log log = {sizeof(nertca_log), on_log, NULL, NERTCA_LOG_WARNING};
  nertca_context *context;
  nertca_reconstruction *reconstruction, *loaded;
  char text[4096];

  if (nertca_abi_version() != NERTCA_ABI_VERSION) {
    fprintf(stderr, "built for ABI %d, the library has %u\n", NERTCA_ABI_VERSION, nertca_abi_version());
    return 1;
  }
  check(nertca_context_create(options, &log, &context), NULL, "nertca_context_create");

  sprintf(text, "phases = %d\nvessel_attenuation_per_mm = 0.05\ntrain.iterations = %u\n",
          PHANTOM_PHASES, iterations);
  check(nertca_reconstruction_create(context, text, &reconstruction), context, "nertca_reconstruction_create");

  /* Four views of each phase to train on; a fifth, with its mask, to score with. */
  static float pixels[SIZE * SIZE];
  static uint8_t mask[SIZE * SIZE];
  for (int phase = 0; phase < PHANTOM_PHASES; phase++) {
    for (size_t view = 0; view <= PHANTOM_VIEWS; view++) {
      int unseen = view == PHANTOM_VIEWS;
      nertca_geometry g = unseen ? phantom_geometry(20, 5, SIZE)
                                 : phantom_geometry(phantom_views[view][0], phantom_views[view][1], SIZE);
      phantom_image(&g, SIZE, phase, pixels, unseen ? mask : NULL);
      nertca_frame frame = phantom_frame(&g, SIZE, phase, pixels, unseen ? mask : NULL);
      check(nertca_reconstruction_add_frame(reconstruction, &frame), reconstruction, "nertca_reconstruction_add_frame");
    }
  }

  uint32_t told = 1, done = 0;
  check(nertca_reconstruction_train(reconstruction, iterations, on_progress, &told, &done), reconstruction,
        "nertca_reconstruction_train");
  printf("trained %u iterations\n", done);

  /* A view that was not among the frames. */
  static uint8_t shown[200 * 200];
  nertca_view view;
  memset(&view, 0, sizeof view);
  view.size = sizeof view;
  view.geometry = phantom_geometry(0, 10, 200);
  view.width = view.height = 200;
  view.phase = 2;
  view.component = NERTCA_COMPONENT_TOTAL;
  view.projection = NERTCA_PROJECTION_DRR;
  view.quality = NERTCA_QUALITY_EXACT;
  nertca_image image;
  memset(&image, 0, sizeof image);
  image.size = sizeof image;
  image.pixels = shown;
  image.pixels_bytes = sizeof shown;
  image.format = NERTCA_PIXELS_U8;
  check(nertca_reconstruction_render(reconstruction, &view, &image), reconstruction, "nertca_reconstruction_render");
  if (png_write(picture, shown, 200, 200) != 0) {
    fprintf(stderr, "%s: cannot be written\n", picture);
    return 1;
  }
  printf("wrote %s\n", picture);

  /* The moving vessels in 3D. */
  static float volume[24 * 24 * 24];
  nertca_grid grid = {sizeof(nertca_grid), {-34.5, -34.5, -34.5}, {3, 3, 3}, {24, 24, 24}, NERTCA_COMPONENT_DYNAMIC, 2};
  double most = 0;
  check(nertca_reconstruction_sample(reconstruction, &grid, volume, sizeof volume / sizeof *volume), reconstruction,
        "nertca_reconstruction_sample");
  for (size_t i = 0; i < sizeof volume / sizeof *volume; i++) most = volume[i] > most ? volume[i] : most;
  printf("largest attenuation of the moving vessels on a 3 mm grid: %.4f per mm\n", most);

  nertca_scores scores;
  memset(&scores, 0, sizeof scores);
  scores.size = sizeof scores;
  check(nertca_reconstruction_evaluate(reconstruction, 0, &scores), reconstruction, "nertca_reconstruction_evaluate");
  printf("unseen view: Dice %.3f, PSNR %.1f dB, SSIM %.3f over %u images\n", scores.dice_dynamic, scores.psnr_db,
         scores.ssim, scores.images);

  /* A checkpoint, through memory, into another reconstruction: the same picture. */
  size_t length = 0;
  check(nertca_reconstruction_save_memory(reconstruction, NULL, 0, &length), reconstruction, "nertca_reconstruction_save_memory");
  void *bytes = malloc(length);
  static uint8_t again[200 * 200];
  if (!bytes) return 1;
  check(nertca_reconstruction_save_memory(reconstruction, bytes, length, &length), reconstruction, "nertca_reconstruction_save_memory");
  check(nertca_reconstruction_create(context, "phases = 1", &loaded), context, "nertca_reconstruction_create");
  check(nertca_reconstruction_load_memory(loaded, bytes, length), loaded, "nertca_reconstruction_load_memory");
  free(bytes);
  image.pixels = again;
  check(nertca_reconstruction_render(loaded, &view, &image), loaded, "nertca_reconstruction_render");
  if (memcmp(shown, again, sizeof shown) != 0) {
    fprintf(stderr, "the loaded checkpoint draws another picture\n");
    return 1;
  }

  check(nertca_reconstruction_destroy(loaded), loaded, "nertca_reconstruction_destroy");
  check(nertca_reconstruction_destroy(reconstruction), reconstruction, "nertca_reconstruction_destroy");
  check(nertca_context_destroy(context), context, "nertca_context_destroy");
  return 0;
}
