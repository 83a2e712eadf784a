// All that Mesa's shim for Intel wants of Mesa about a device: tools/null-gpu puts it in place of dev/intel_device_info.h.
#include <stdbool.h>
#include <stdint.h>
#include <string.h>
enum { INTEL_PLATFORM_CHV = -1 };
enum { INTEL_ENGINE_CLASS_RENDER = 0, INTEL_ENGINE_CLASS_COPY = 1 };
struct drm_intel_stub_devinfo { uint64_t addr; uint32_t size; };
struct intel_device_info {
   int pci_device_id, num_slices, num_subslices[8], max_eus_per_subslice, ver, platform;
   bool has_local_mem;
   uint64_t timestamp_frequency;
};
static const struct { const char *name; int pci_id, slices, subslices, eus, ver; bool local; } null_intel[] = {
   { "tgl", 0x9a49, 1, 6, 16, 12, false },  /* Tiger Lake */
   { "dg2", 0x56a0, 8, 4, 16, 12, true },   /* Arc A770 */
   { "mtl", 0x7d55, 2, 4, 16, 12, false },  /* Meteor Lake */
   { "arl", 0x7d51, 2, 4, 16, 12, false },  /* Arrow Lake H: Xe-LPG+, with matrix units */
   { "lnl", 0x64a0, 2, 4, 8, 20, false },   /* Lunar Lake */
   { "bmg", 0xe20b, 5, 4, 8, 20, true },    /* Arc B580 */
   { "ptl", 0xb080, 3, 4, 8, 30, false },   /* Panther Lake */
};
static inline int intel_device_name_to_pci_device_id(const char *name)
{
   for (unsigned i = 0; i < sizeof(null_intel) / sizeof(*null_intel); i++)
      if (!strcmp(null_intel[i].name, name))
         return null_intel[i].pci_id;
   return -1;
}
static inline bool intel_get_device_info_from_pci_id(int id, struct intel_device_info *info)
{
   for (unsigned i = 0; i < sizeof(null_intel) / sizeof(*null_intel); i++) {
      if (null_intel[i].pci_id != id)
         continue;
      *info = (struct intel_device_info) { .pci_device_id = id, .num_slices = null_intel[i].slices,
         .max_eus_per_subslice = null_intel[i].eus, .ver = null_intel[i].ver, .has_local_mem = null_intel[i].local,
         .timestamp_frequency = 19200000 };
      for (int s = 0; s < info->num_slices; s++)
         info->num_subslices[s] = null_intel[i].subslices;
      return true;
   }
   return false;
}
static inline bool intel_device_info_from_json(const char *path, struct intel_device_info *info) { return false; }
