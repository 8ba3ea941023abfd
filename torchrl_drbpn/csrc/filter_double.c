/* The filter for tensors of double; see filter.h. */
typedef double given;
#define NAME(function) function##_double
#include "filter.h"
