/* Writes an 8-bit grey PNG without compression: enough for an example, and no library needed. */
#ifndef NERTCA_EXAMPLE_PNG_H
#define NERTCA_EXAMPLE_PNG_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static uint32_t png_crc(const uint8_t *bytes, size_t n) {
  uint32_t crc = 0xffffffffu;
  for (size_t i = 0; i < n; i++) {
    crc ^= bytes[i];
    for (int k = 0; k < 8; k++) crc = crc & 1 ? 0xedb88320u ^ (crc >> 1) : crc >> 1;
  }
  return ~crc;
}

static void png_u32(uint8_t *to, uint32_t v) {
  to[0] = (uint8_t)(v >> 24), to[1] = (uint8_t)(v >> 16), to[2] = (uint8_t)(v >> 8), to[3] = (uint8_t)v;
}

static int png_chunk(FILE *file, const char *name, const uint8_t *data, uint32_t n) {
  uint8_t *chunk = malloc(n + 12u);
  int ok;
  if (!chunk) return 0;
  png_u32(chunk, n);
  memcpy(chunk + 4, name, 4);
  if (n) memcpy(chunk + 8, data, n);
  png_u32(chunk + 8 + n, png_crc(chunk + 4, n + 4u));
  ok = fwrite(chunk, 1, n + 12u, file) == n + 12u;
  free(chunk);
  return ok;
}

/* 0 on success. */
static int png_write(const char *path, const uint8_t *pixels, uint32_t width, uint32_t height) {
  uint8_t head[13] = {0};
  size_t raw = (size_t)height * (width + 1), blocks = (raw + 65534) / 65535, at = 0;
  uint8_t *data = malloc(raw + 6 + 5 * blocks), *flat = malloc(raw);
  uint32_t a = 1, b = 0;
  int ok = data && flat;
  FILE *file = ok ? fopen(path, "wb") : NULL;
  if (file) {
    for (uint32_t y = 0; y < height; y++) {
      flat[y * (width + 1)] = 0;
      memcpy(flat + y * (width + 1) + 1, pixels + (size_t)y * width, width);
    }
    for (size_t i = 0; i < raw; i++) a = (a + flat[i]) % 65521, b = (b + a) % 65521;
    data[at++] = 0x78, data[at++] = 0x01;
    for (size_t from = 0; from < raw; from += 65535) {
      size_t n = raw - from < 65535 ? raw - from : 65535;
      data[at++] = from + n == raw;
      data[at++] = (uint8_t)n, data[at++] = (uint8_t)(n >> 8), data[at++] = (uint8_t)~n, data[at++] = (uint8_t)(~n >> 8);
      memcpy(data + at, flat + from, n);
      at += n;
    }
    png_u32(data + at, b << 16 | a);
    at += 4;
    png_u32(head, width), png_u32(head + 4, height);
    head[8] = 8;
    ok = fwrite("\x89PNG\r\n\x1a\n", 1, 8, file) == 8 && png_chunk(file, "IHDR", head, 13) &&
         png_chunk(file, "IDAT", data, (uint32_t)at) && png_chunk(file, "IEND", NULL, 0);
    ok = fclose(file) == 0 && ok;
  } else {
    ok = 0;
  }
  free(data), free(flat);
  return ok ? 0 : -1;
}

#endif
