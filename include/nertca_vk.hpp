#pragma once
#include "nertca_vk.h"
