/* Angiograms of a beating vessel made of Gaussian blobs, whose line integrals are known exactly: data for the examples.
 * Copy nothing from here into a product. */
#ifndef NERTCA_EXAMPLE_PHANTOM_H
#define NERTCA_EXAMPLE_PHANTOM_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "nertca_vk.h"

#define PHANTOM_PHASES 8
#define PHANTOM_BLOBS 160
#define PHANTOM_SID_MM 1100.0
#define PHANTOM_SOD_MM 750.0
#define PHANTOM_FOV_MM 130.0

static const double phantom_views[][2] = {{-30, 25}, {40, 20}, {-45, -20}, {5, -30}};
#define PHANTOM_VIEWS (sizeof phantom_views / sizeof *phantom_views)

static nertca_geometry phantom_geometry(double primary_deg, double secondary_deg, uint32_t size) {
  nertca_geometry g;
  memset(&g, 0, sizeof g);
  g.size = sizeof g;
  g.primary_deg = primary_deg;
  g.secondary_deg = secondary_deg;
  g.sid_mm = PHANTOM_SID_MM;
  g.sod_mm = PHANTOM_SOD_MM;
  g.pixel_mm[0] = g.pixel_mm[1] = PHANTOM_FOV_MM / PHANTOM_SOD_MM * PHANTOM_SID_MM / size;
  return g;
}

/* A vector of the C-arm (columns, rows, beam) in patient mm (left, posterior, superior). */
static void phantom_turn(const nertca_geometry *g, const double v[3], double lps[3]) {
  const double degree = 3.14159265358979323846 / 180.0;
  double p = g->primary_deg * degree, s = g->secondary_deg * degree;
  /* Rx(-90), Rx(secondary), Rz(90), Rz(-primary) on axes (posterior, left, superior). */
  double x = v[0], y = v[2], z = -v[1];
  double y1 = cos(s) * y - sin(s) * z, z1 = sin(s) * y + cos(s) * z;
  double x2 = -y1, y2 = x;
  double x3 = cos(p) * x2 + sin(p) * y2, y3 = -sin(p) * x2 + cos(p) * y2;
  lps[0] = y3;
  lps[1] = x3;
  lps[2] = z1;
}

/* Line integrals of vessel and background, and a mask of the vessel (may be null). */
static void phantom_image(const nertca_geometry *g, uint32_t size, int phase, float *pixels, uint8_t *mask) {
  const double pi = 3.14159265358979323846, radius = 0.9, attenuation = 0.05;
  double blobs[PHANTOM_BLOBS][3], source[3];
  const double back[3] = {0, 0, -g->sod_mm}, body[3] = {45, 20, 55};
  double beat = sin(2 * pi * phase / PHANTOM_PHASES);
  for (int b = 0; b < PHANTOM_BLOBS; b++) {
    double t = (double)b / (PHANTOM_BLOBS - 1), a = 1.7 * pi * t;
    double shrink = 1.0 - 0.18 * beat;
    blobs[b][0] = 26 * shrink * cos(a) + 3 * beat;
    blobs[b][1] = 26 * shrink * sin(a);
    blobs[b][2] = 34 * (t - 0.5) * (1 - 0.1 * beat) + 4 * sin(3 * a);
  }
  phantom_turn(g, back, source);
  for (uint32_t j = 0; j < size; j++)
    for (uint32_t i = 0; i < size; i++) {
      const double v[3] = {((double)i + 0.5 - size / 2.0) * g->pixel_mm[0] / g->sid_mm,
                           ((double)j + 0.5 - size / 2.0) * g->pixel_mm[1] / g->sid_mm, 1.0};
      double d[3], norm, vessel = 0, background = 0;
      phantom_turn(g, v, d);
      norm = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
      for (int b = -1; b < PHANTOM_BLOBS; b++) {
        double along = 0, far2 = 0, sum;
        for (int k = 0; k < 3; k++) {
          double to = (b < 0 ? body[k] : blobs[b][k]) - source[k];
          along += to * d[k] / norm;
          far2 += to * to;
        }
        far2 -= along * along;
        sum = b < 0 ? 0.9 * exp(-far2 / (2 * 60.0 * 60.0))
                    : attenuation * 1.0 * radius * sqrt(2 * pi) * exp(-far2 / (2 * radius * radius));
        if (b < 0) background = sum; else vessel += sum;
      }
      pixels[j * size + i] = (float)(background + vessel);
      if (mask) mask[j * size + i] = vessel > 0.04;
    }
}

/* A frame that points to `pixels` and `mask`. */
static nertca_frame phantom_frame(const nertca_geometry *g, uint32_t size, int phase, const float *pixels,
                                  const uint8_t *mask) {
  nertca_frame f;
  memset(&f, 0, sizeof f);
  f.size = sizeof f;
  f.geometry = *g;
  f.pixels = pixels;
  f.pixels_bytes = sizeof(float) * size * size;
  f.width = f.height = size;
  f.format = NERTCA_PIXELS_F32;
  f.intensity = NERTCA_INTENSITY_INTEGRAL;
  f.phase = phase;
  f.split = mask ? NERTCA_SPLIT_VALIDATION : NERTCA_SPLIT_TRAIN;
  f.mask = mask;
  f.mask_bytes = mask ? (size_t)size * size : 0;
  return f;
}

#endif
