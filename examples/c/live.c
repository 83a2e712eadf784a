/* Frames arrive phase by phase while training goes on in the background and a render loop draws the moving vessels:
 * prints how long drawing took, and how much it slowed training down. Pictures and iterations are counted, not seconds:
 * a busy machine takes longer, and does the same.
 *
 *   cc live.c -o live $(pkg-config --cflags --libs nertca_vk) -lm -lpthread
 *   ./live [PICTURES] [FRAMES PER SECOND] [CONTEXT OPTIONS]
 */
#define _POSIX_C_SOURCE 200809L
#include "nertca_vk.h"
#include "phantom.h"

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define SIZE 100u
#define SHOWN 200u
#define MOST 100000
/* Line integral above which a drawn pixel shows a vessel, as in the phantom's masks, and agreement (Dice) with the mask of
 * an unseen view from which on an overlay is of use. */
#define VISIBLE 0.04f
#define USABLE 0.7
/* In turn: iterations without drawing, and pictures drawn. */
#define ALONE_STEPS 20u
#define TURN 20
/* Whoever waits longer than this for one thing waits in vain. */
#define PATIENCE_S 900.0

static void check(nertca_status status, const void *handle, const char *call) {
  char text[512] = "";
  if (status == NERTCA_OK) return;
  nertca_last_error(handle, text, sizeof text, NULL);
  fprintf(stderr, "%s: %s: %s\n", call, nertca_status_text(status), text);
  exit(1);
}

static double now_s(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void sleep_s(double seconds) {
  struct timespec t;
  if (seconds <= 0) return;
  t.tv_sec = (time_t)seconds;
  t.tv_nsec = (long)(1e9 * (seconds - (double)t.tv_sec));
  nanosleep(&t, NULL);
}

/* Ends the program when something that was begun at `begin` will not come any more. */
static void be_patient(double begin, const char *what) {
  if (now_s() - begin < PATIENCE_S) return;
  fprintf(stderr, "%s: not within %.0f s\n", what, PATIENCE_S);
  exit(1);
}

static int by_size(const void *a, const void *b) {
  double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static nertca_progress look(nertca_reconstruction *reconstruction) {
  nertca_progress progress;
  memset(&progress, 0, sizeof progress);
  progress.size = sizeof progress;
  check(nertca_reconstruction_progress(reconstruction, &progress), reconstruction, "nertca_reconstruction_progress");
  if (progress.state == NERTCA_STATE_FAILED) {
    char text[512];
    nertca_reconstruction_failure(reconstruction, text, sizeof text, NULL);
    fprintf(stderr, "training failed: %s\n", text);
    exit(1);
  }
  return progress;
}

/* Waits for iterations; how many there were. */
static double train_alone(nertca_reconstruction *reconstruction) {
  uint32_t first = look(reconstruction).step, step = first;
  double begin = now_s();
  while (step < first + ALONE_STEPS) {
    be_patient(begin, "iterations without drawing");
    sleep_s(0.01);
    step = look(reconstruction).step;
  }
  return step - first;
}

/* Agreement of a picture with a mask, 0 to 1. */
static double dice(const float *picture, const uint8_t *mask) {
  unsigned both = 0, sum = 0;
  for (unsigned i = 0; i < SHOWN * SHOWN; i++) {
    int seen = picture[i] > VISIBLE;
    both += seen && mask[i];
    sum += (unsigned)seen + (mask[i] != 0);
  }
  return sum ? 2.0 * both / sum : 0;
}

int main(int argc, char **argv) {
  int pictures = argc > 1 ? atoi(argv[1]) : 200;
  double rate = argc > 2 ? atof(argv[2]) : 10;
  nertca_context *context;
  nertca_reconstruction *reconstruction;
  char options[256];
  static float pixels[SIZE * SIZE], shown[SHOWN * SHOWN], first_shown[SHOWN * SHOWN];
  static float truth[SHOWN * SHOWN];
  static uint8_t mask[SHOWN * SHOWN];
  static double took[MOST];
  int drawn = 0;

  if (pictures < 1 || pictures > MOST || !(rate > 0)) {
    fprintf(stderr, "1 to %d pictures at a positive rate are drawn\n", MOST);
    return 2;
  }
  check(nertca_context_create(argc > 3 ? argv[3] : NULL, NULL, &context), NULL, "nertca_context_create");
  sprintf(options, "phases = %d\ntrain.iterations = 100000\nvessel_attenuation_per_mm = 0.05", PHANTOM_PHASES);
  check(nertca_reconstruction_create(context, options, &reconstruction), context, "nertca_reconstruction_create");
  check(nertca_reconstruction_start(reconstruction, NULL, NULL), reconstruction, "nertca_reconstruction_start");

  /* The C-arm's side: one phase of all views at a time. */
  for (int phase = 0; phase < PHANTOM_PHASES; phase++) {
    for (size_t view = 0; view < PHANTOM_VIEWS; view++) {
      nertca_geometry g = phantom_geometry(phantom_views[view][0], phantom_views[view][1], SIZE);
      phantom_image(&g, SIZE, phase, pixels, NULL);
      nertca_frame frame = phantom_frame(&g, SIZE, phase, pixels, NULL);
      check(nertca_reconstruction_add_frame(reconstruction, &frame), reconstruction, "nertca_reconstruction_add_frame");
    }
    sleep_s(0.2);
  }
  double begin = now_s();
  nertca_view view;
  memset(&view, 0, sizeof view);
  view.size = sizeof view;
  view.geometry = phantom_geometry(10, 20, SHOWN);
  view.width = view.height = SHOWN;
  view.component = NERTCA_COMPONENT_DYNAMIC;
  nertca_image image;
  memset(&image, 0, sizeof image);
  image.size = sizeof image;
  image.pixels = shown;
  image.pixels_bytes = sizeof shown;
  image.format = NERTCA_PIXELS_F32;

  /* From the last frame to an overlay of use. */
  double agreement = 0;
  phantom_image(&view.geometry, SHOWN, 0, truth, mask);
  while (look(reconstruction).frames < PHANTOM_PHASES * PHANTOM_VIEWS || agreement < USABLE) {
    be_patient(begin, "an overlay of use");
    sleep_s(0.05);
    nertca_status drawn_now = nertca_reconstruction_render(reconstruction, &view, &image);
    if (drawn_now == NERTCA_ERROR_NOT_READY) continue;
    check(drawn_now, reconstruction, "nertca_reconstruction_render");
    agreement = dice(shown, mask);
  }
  printf("an overlay that agrees with an unseen view (Dice %.2f) came %.2f s after the last frame\n", agreement,
         now_s() - begin);

  /* The first picture of each phase also builds its volume. */
  for (uint32_t phase = 0; phase < PHANTOM_PHASES; phase++) {
    view.phase = phase;
    check(nertca_reconstruction_render(reconstruction, &view, &image), reconstruction, "nertca_reconstruction_render");
    if (phase == 0) memcpy(first_shown, shown, sizeof shown);
  }

  /* Training alone and with the render loop, in turn, so that both see the same machine. */
  double alone_s = 0, beside_s = 0, alone_steps = 0, beside_steps = 0;
  while (drawn < pictures) {
    double from = now_s();
    alone_steps += train_alone(reconstruction);
    alone_s += now_s() - from;
    uint32_t first = look(reconstruction).step;
    from = now_s();
    for (int i = 0; i < TURN && drawn < pictures; i++) {
      double start = now_s();
      view.phase = (uint32_t)drawn % PHANTOM_PHASES;
      check(nertca_reconstruction_render(reconstruction, &view, &image), reconstruction, "nertca_reconstruction_render");
      took[drawn++] = now_s() - start;
      sleep_s(1 / rate - (now_s() - start));
    }
    beside_steps += look(reconstruction).step - first;
    beside_s += now_s() - from;
  }

  /* What is drawn follows training. */
  view.phase = 0;
  begin = now_s();
  do {
    be_patient(begin, "a picture that differs from the first of its phase");
    check(nertca_reconstruction_render(reconstruction, &view, &image), reconstruction, "nertca_reconstruction_render");
  } while (memcmp(first_shown, shown, sizeof shown) == 0);
  check(nertca_reconstruction_stop(reconstruction), reconstruction, "nertca_reconstruction_stop");

  qsort(took, (size_t)drawn, sizeof *took, by_size);
  printf("%d pictures of %u x %u while training: median %.1f ms, p90 %.1f ms, p99 %.1f ms, most %.1f ms\n", drawn, SHOWN,
         SHOWN, 1e3 * took[drawn / 2], 1e3 * took[drawn * 9 / 10], 1e3 * took[drawn * 99 / 100], 1e3 * took[drawn - 1]);
  double alone = alone_steps / alone_s, beside = beside_steps / beside_s;
  printf("training: %.1f iterations/s alone, %.1f beside %.0f pictures/s: %.1f %% slower\n", alone, beside, rate,
         100 * (1 - beside / alone));

  check(nertca_reconstruction_destroy(reconstruction), reconstruction, "nertca_reconstruction_destroy");
  check(nertca_context_destroy(context), context, "nertca_context_destroy");
  return 0;
}
