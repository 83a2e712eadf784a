# find_package(nertca_vk): the target nertca_vk::nertca_vk, from beside this file.
get_filename_component(_prefix "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
find_path(nertca_vk_INCLUDE_DIR nertca_vk.h HINTS "${_prefix}/include" NO_DEFAULT_PATH)
find_library(nertca_vk_LIBRARY nertca_vk HINTS "${_prefix}/lib" "${_prefix}/lib64" "${_prefix}/lib/${CMAKE_LIBRARY_ARCHITECTURE}" NO_DEFAULT_PATH)
include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(nertca_vk REQUIRED_VARS nertca_vk_LIBRARY nertca_vk_INCLUDE_DIR VERSION_VAR PACKAGE_VERSION)
if(nertca_vk_FOUND AND NOT TARGET nertca_vk::nertca_vk)
  add_library(nertca_vk::nertca_vk SHARED IMPORTED)
  set_target_properties(nertca_vk::nertca_vk PROPERTIES
    IMPORTED_LOCATION "${nertca_vk_LIBRARY}" INTERFACE_INCLUDE_DIRECTORIES "${nertca_vk_INCLUDE_DIR}")
endif()
unset(_prefix)
