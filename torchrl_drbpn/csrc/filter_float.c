/* The filter for tensors of float; see filter.h. */
typedef float given;
#define NAME(function) function##_float
#include "filter.h"
